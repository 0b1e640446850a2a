"""Samplers: the levels of new episodes, given the level that the advance rule has reached.

A sampler is called as ``sampler(level, first, count)``, with the number of the first level, and returns level numbers,
int64 ``[count]``, one for each problem. Only problems that begin an episode use theirs, so each is drawn independently.
Levels that differ in the tote's height alone are numbered by their heights.
"""

import torch
from torch import Tensor

from pickplace.common.validate import expect, number


class Current:
    """Sampler: every episode plays at the level reached."""

    def __call__(self, level: int, first: int, count: int) -> Tensor:
        return torch.full((count,), level, dtype=torch.int64)


class Uniform:
    """Sampler: uniform from the first level to the one reached, drawn from torch's global generator."""

    def __call__(self, level: int, first: int, count: int) -> Tensor:
        return torch.randint(first, level + 1, (count,))


class Recent:
    """Sampler: the level reached, and a share of episodes at earlier levels to prevent forgetting.

    Args:
        share: probability in [0, 1) of an earlier level, drawn uniformly from torch's global generator.
    """

    def __init__(self, share: float = 0.25):
        key = "curriculum.sample.share"
        self.share = expect(number(key, share, most=1) < 1, key, share, "a number below 1")

    def __call__(self, level: int, first: int, count: int) -> Tensor:
        earlier = torch.randint(first, max(level, first + 1), (count,))
        return torch.where(torch.rand(count) < self.share, earlier, level)
