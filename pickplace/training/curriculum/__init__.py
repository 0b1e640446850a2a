"""Curricula: what each training episode is like.

A curriculum is levels x advance rule x sampler. A level says what its episodes set, such as the height of the tote or
the items (``levels``). ``curriculum.Curriculum`` lives in the main process, which alone owns the level, and asks its
advance rule after each batch. The transform ``transform.ToteHeightCurriculum`` draws the levels of episodes in every
collector process, and ``push_level`` sends it the one reached.
"""
