"""The base of networks that estimate the volume that totes will still take."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pickplace.common.capture import is_capturing
from pickplace.common.validate import flag, number, one_of
from pickplace.policies.dtypes import DTYPES
from pickplace.rules.state import State

FLIPS: tuple[list[int], ...] = ([], [1], [2], [1, 2])  # axes along which maps of totes ``[N, W_T, D_T]`` are flipped


class ToteValue(nn.Module, ABC):
    """Estimates the volume that a tote will still take. The value is a sum of parts, and each part is learnt.

    Args:
        mirrored: whether totes are mirrored and transposed at random in training. The true value stays the same, unless
            items, end effector or reach treat the sides of the tote differently.
        all_views: whether a value is the mean over all these views of a tote, in evaluation mode (``eval()``). With
            eight views this takes eight times as long.
        reward_scale: the config's ``reward_scale``; values are volumes times this.
        compute_dtype: as in :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`.

    Attributes:
        in_keys: entries of the observation that it reads, in order.
        cells_at_once: by type of device, number of cells whose activations are held at a time without gradients.
    """

    in_keys: tuple[str, ...]
    validates_as_trained = True  # all views would take eight times as long
    cells_at_once = {"cpu": 2**18, "cuda": 2**24}  # what a CPU's caches hold

    def __init__(
        self, mirrored: bool = True, all_views: bool = False, reward_scale: float = 1.0, compute_dtype: str = "auto"
    ):
        super().__init__()
        self.mirrored = flag("model.actor.mirrored", mirrored)
        self.all_views = flag("model.actor.all_views", all_views)
        self.reward_scale = number("model.actor.reward_scale", reward_scale, 1e-9, 1e38)  # the training's
        self.compute_dtype = one_of("model.actor.compute_dtype", compute_dtype, DTYPES)

    def forward(self, *entries: Tensor) -> Tensor:
        """Return the value of each tote, float32 ``[..., 1]``, from the entries :attr:`in_keys`, such as ``tote_depth``
        ``[..., W_T, D_T]`` and ``tote_height`` ``[..., 1]``. ``items`` are those that wait after a placement, before
        others arrive."""
        batch, wide, deep = entries[0].shape[:-2], *entries[0].shape[-2:]
        flat = tuple(entry.flatten(0, len(batch) - 1) for entry in entries)
        if self.training or not (self.mirrored and self.all_views):
            return self.parts(*flat).flatten(1).sum(1).view(*batch, 1)
        means = []
        for turned in (False, True) if self.can_transpose(wide, deep) else (False,):
            views = zip(*(flip_and_transpose(flat, axes, turned) for axes in FLIPS), strict=True)
            values = self.parts(*(torch.cat(entry) for entry in views)).flatten(1).sum(1)
            means.append(values.view(len(FLIPS), -1).mean(0))
        return torch.stack(means).mean(0).view(*batch, 1)

    def judge(self, before: State, *entries: Tensor) -> Tensor:
        """Return the values of totes after a placement, float32 ``[N, 1]``, to compare placements.

        Args:
            before: the states before the placements, ``[N]``.
            entries: as in :meth:`forward`, ``[N, ...]``.
        """
        return self(*entries)

    def parts(self, *entries: Tensor) -> Tensor:
        """Return the parts of the value, float32 ``[N, ...]``, of entries ``[N, ...]``."""
        device, (wide, deep) = entries[0].device.type, entries[0].shape[1:]
        at_once = max(1, self.cells_at_once.get(device, self.cells_at_once["cpu"]) // self.cells(wide, deep))
        if torch.is_grad_enabled() or len(entries[0]) <= at_once:
            return self.chunk_parts(*entries)
        some = zip(*(entry.split(at_once) for entry in entries), strict=True)
        return torch.cat([self.chunk_parts(*each) for each in some])

    def cells(self, wide: int, deep: int) -> int:
        """Return the number of cells that the network looks at in a tote of ``wide x deep``."""
        return wide * deep

    @abstractmethod
    def chunk_parts(self, *entries: Tensor) -> Tensor:
        """Return :meth:`parts` for totes that are few enough to compute at once."""

    @abstractmethod
    def learning_bytes(self, wide: int, deep: int) -> int:
        """Return the approximate bytes of a tote of ``wide x deep`` cells in a gradient step."""

    @abstractmethod
    def credit(self, before: Sequence[Tensor], after: Sequence[Tensor]) -> Tensor:
        """Return the share of a placement's reward that each part of the value earns, float32 ``[N, ...]``.

        Args:
            before, after: the entries of totes before and after the placement, ``[N, ...]`` each.
        """

    def random_view(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Return maps mirrored and transposed at random, as far as the value stays the same.

        Args:
            maps: as in :func:`flip_and_transpose`.
        """
        if not self.mirrored:
            return maps
        wide, deep = maps[0].shape[1:]
        draws = torch.rand(3, device=maps[0].device if is_capturing() else None) < 0.5
        if is_capturing():  # the device selects among all views, which must have one shape
            views: list[tuple[list[int], bool]] = [([1], False), ([2], False), ([], True)]
            for (axes, turned), drawn in zip(views, draws.roll(-1), strict=True):
                if not turned or (wide == deep and self.can_transpose(wide, deep)):
                    pairs = zip(maps, flip_and_transpose(maps, axes, turned), strict=True)
                    maps = tuple(torch.where(drawn, new, old) for old, new in pairs)
            return maps
        turned, *flips = draws.tolist()
        axes = [axis for axis, flipped in zip((1, 2), flips, strict=True) if flipped]
        return flip_and_transpose(maps, axes, turned and self.can_transpose(wide, deep))

    def can_transpose(self, wide: int, deep: int) -> bool:
        """Return whether a tote of these sides may be transposed."""
        return True


def flip_and_transpose(entries: Sequence[Tensor], axes: list[int], turned: bool) -> tuple[Tensor, ...]:
    """Return the entries with all maps ``[N, W_T, D_T]`` flipped along axes, then transposed if ``turned``.

    In tables of items, int64 ``[N, M, 5]``, ``turned`` exchanges x and y. Entries with another number of dimensions are
    returned unchanged.
    """
    return tuple(_seen_from(entry, axes, turned) if entry.dim() == 3 else entry for entry in entries)


def _seen_from(entry: Tensor, axes: list[int], turned: bool) -> Tensor:
    if not entry.is_floating_point():
        y, x, d, w, h = entry.unbind(-1)  # positions in the bin do not matter
        return torch.stack([x, y, w, d, h], -1) if turned else entry
    flipped = entry.flip(axes)
    return flipped.transpose(1, 2) if turned else flipped
