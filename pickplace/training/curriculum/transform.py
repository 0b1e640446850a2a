"""The TorchRL transform that writes episode settings into resets, and the function that sends it the level."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from pickplace.common.validate import expect, integral_number
from pickplace.training.curriculum.levels import Levels


class ToteHeightCurriculum(Transform):
    """Write the settings of levels, such as ``tote_height``, int64 ``[N, 1]``, into full and partial resets.

    Running episodes keep their settings. It must be the first transform of the environment's ``Compose``, where
    :func:`push_level` finds it.

    Args:
        level: number of the first level.
        sampler: returns level numbers for ``(level, first, count)``; see
            :mod:`pickplace.training.curriculum.sample`.
        levels: the levels and their settings.
        weights: weight of each level for the draw; empty: the sampler draws.
    """

    def __init__(self, level: int, sampler, levels: Levels, weights: Sequence[float] = ()):
        super().__init__()
        self.sampler, self.levels, self.weights = sampler, levels, _relative(weights)
        # A buffer, so that it is in state_dict() and follows the environment to its device.
        self.register_buffer("level", torch.tensor(integral_number("level", level, levels.first)))

    def set_level(self, level: int, weights: Sequence[float] = ()) -> None:
        """Draw the levels of later episodes at this level, or by these weights."""
        self.level.fill_(integral_number("level", level, self.levels.first))
        self.weights = _relative(weights)

    def _draw(self, count: int) -> Tensor:
        """Return level numbers of new episodes, int64 ``[count]``."""
        first, last = self.levels.first, self.levels.last
        if len(self.weights):
            return first + torch.multinomial(self.weights, count, replacement=True)
        drawn = self.sampler(int(self.level), first, count)
        good = isinstance(drawn, Tensor) and drawn.numel() == count and not drawn.is_floating_point()
        expected = f"whole numbers between {first} and {last} in a tensor [{count}]"
        expect(good and first <= drawn.min() and drawn.max() <= last, "curriculum.sample: its levels", drawn, expected)
        return drawn.reshape(-1).cpu()

    def draw(self, batch_size: torch.Size) -> dict[str, Tensor]:
        """Return the settings of new episodes, by their names, ``[*batch_size, ...]`` each."""
        level = self._draw(batch_size.numel()) - self.levels.first
        device = self.level.device
        return {key: entries[level].to(device).reshape(*batch_size, -1) for key, entries in self.levels.entries.items()}

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:  # a plain env.reset()
            tensordict = TensorDict(batch_size=self.parent.batch_size, device=self.parent.device)
        reset = tensordict.get("_reset", None)
        for key, value in self.draw(tensordict.batch_size).items():
            # Collectors hide these from a reset; running rows then get drawn values too, which nothing reads.
            if reset is not None and (running := tensordict.get(key, None)) is not None:
                value = torch.where(reset.reshape(*tensordict.batch_size, 1), value, running)
            tensordict = tensordict.set(key, value)
        return tensordict


def _relative(weights: Sequence[float]) -> Tensor:
    """Return the weights divided by the greatest one: torch cannot draw by weights whose sum is infinite."""
    shares = torch.tensor([*weights], dtype=torch.float64)
    return (shares / shares.max()).float() if len(shares) else shares


def push_level(collector, level: int, weights: Sequence[float] = ()) -> None:
    """Set the level, or the weights of the levels, in every process of a collector, between two batches.

    ``map_fn(path, list_of_args)`` calls the method at that path: a direct collector calls it once per entry of the
    list; a multi-process one calls it once in each worker and needs ``num_workers`` entries. Results travel back
    through a pipe, so the path ends at a method that returns nothing.
    """
    collector.map_fn("env.transform[0].set_level", [(level, [*weights])] * getattr(collector, "num_workers", 1))
