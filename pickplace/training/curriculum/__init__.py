"""Curricula: the tote height of each training episode.

A curriculum is levels x advance rule x height sampler; a level is a tote height in cells. :class:`Curriculum` lives in
the main process, which alone owns the level, and asks its advance rule after each batch. The transform
:class:`ToteHeightCurriculum` draws the heights in every collector process, and :func:`push_level` sends it the level.
"""

from pickplace.training.curriculum.advance import Advance, Frames, NoAdvance, Plateau, Staged, Tally, Threshold
from pickplace.training.curriculum.levels import Curriculum
from pickplace.training.curriculum.sample import Current, Recent, Uniform
from pickplace.training.curriculum.transform import ToteHeightCurriculum, push_level

__all__ = [
    "Advance", "Current", "Curriculum", "Frames", "NoAdvance", "Plateau", "Recent", "Staged", "Tally", "Threshold",
    "ToteHeightCurriculum", "Uniform", "push_level",
]  # fmt: skip
