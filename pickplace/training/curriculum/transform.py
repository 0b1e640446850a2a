"""The TorchRL transform that writes tote heights into resets, and the way the level reaches it."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from pickplace.common.validate import expect, integral_number


class ToteHeightCurriculum(Transform):
    """Write ``tote_height``, int64 ``[N, 1]``, into full and partial resets; running episodes keep their height.

    It must be the first transform of the environment's ``Compose``, where :func:`push_level` finds it.

    Args:
        level: the first level.
        sampler: returns heights for ``(level, min_height, count)``; see :mod:`pickplace.training.curriculum.sample`.
        min_height: the least height the sampler may draw.
    """

    def __init__(self, level: int, sampler, min_height: int):
        super().__init__()
        self.sampler, self.min_height = sampler, integral_number("min_height", min_height)
        # A buffer, so that it is in state_dict() and follows the environment to its device.
        self.register_buffer("level", torch.tensor(integral_number("level", level, min_height)))

    def set_level(self, level: int) -> None:
        """Draw the heights of later episodes at this level."""
        self.level.fill_(integral_number("level", level, self.min_height))

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:  # a plain env.reset()
            tensordict = TensorDict(batch_size=self.parent.batch_size, device=self.parent.device)
        count = tensordict.numel()
        height = self.sampler(int(self.level), self.min_height, count)
        expect(
            isinstance(height, Tensor) and height.numel() == count and not height.is_floating_point(),
            "curriculum.sample: its heights",
            height,
            f"whole numbers in a tensor [{count}]",
        )
        height = height.to(self.level.device).reshape(*tensordict.batch_size, 1)
        reset, running = tensordict.get("_reset", None), tensordict.get("tote_height", None)
        # Collectors hide `tote_height` from a reset; running rows then get a drawn height too, which nothing reads.
        if reset is not None and running is not None:
            height = torch.where(reset.reshape(height.shape), height, running)
        return tensordict.set("tote_height", height)


def push_level(collector, level: int) -> None:
    """Set the level in every process of a collector, between two batches.

    ``map_fn(path, list_of_args)`` calls the method at that path: a direct collector calls it once per entry of the
    list; a multi-process one calls it once in each worker and needs ``num_workers`` entries. Results travel back
    through a pipe, so the path ends at a method that returns nothing.
    """
    collector.map_fn("env.transform[0].set_level", [(level,)] * getattr(collector, "num_workers", 1))
