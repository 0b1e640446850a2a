"""Height samplers: the tote heights of new episodes, given the level.

A sampler is called as ``sampler(level, min_height, count)`` and returns heights, int64 ``[count]``.
"""

import torch
from torch import Tensor

from pickplace.common.validate import number


class Current:
    """Height sampler: every episode plays at the level."""

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        return torch.full((count,), level, dtype=torch.int64)


class Uniform:
    """Height sampler: uniform from the least height to the level, drawn from torch's global generator."""

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        return torch.randint(min_height, level + 1, (count,))


class Recent:
    """Height sampler: the level, and a share of episodes at earlier heights to prevent forgetting.

    Args:
        share: probability in [0, 1] of an earlier height, drawn uniformly from torch's global generator.
    """

    def __init__(self, share: float = 0.25):
        self.share = number("curriculum.sample.share", share, most=1)

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        earlier = torch.randint(min_height, max(level, min_height + 1), (count,))
        return torch.where(torch.rand(count) < self.share, earlier, level)
