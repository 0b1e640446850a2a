"""Curricula: the settings of training episodes, level by level.

A curriculum has levels, an advance rule and a sampler. A level is a set of episode settings, such as the height of the
tote or the items (``levels``). ``curriculum.Curriculum`` lives in the main process and alone owns the current level. It
asks its advance rule after each batch. The transform ``transform.ToteHeightCurriculum`` draws the levels of episodes in
every collector process, and ``push_level`` sends it the current level.
"""
