"""Curricula: the tote height of each training episode.

A curriculum is levels x advance rule x height sampler; a level is a tote height in cells. ``levels.Curriculum`` lives
in the main process, which alone owns the level, and asks its advance rule after each batch. The transform
``transform.ToteHeightCurriculum`` draws the heights in every collector process, and ``push_level`` sends it the level.
"""
