"""Placing by measured maps: the rules for a surface that does not follow the grid.

A measured height has an error of some height units, and a cell of the grid need not be level. So the maps are finer
than the grid: each cell is a square of *patches*, with the least and the greatest height in each. An obstacle counts
with its greatest height, a support with its least. Footprints, offsets and actions are those of the grid, and all
comparisons are those of the rules.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import FOOTPRINT, EffectorOverTote, Resting, combine
from pickplace.rules.failures import failure_codes
from pickplace.rules.grasps import carry, split_action
from pickplace.rules.item import Item
from pickplace.rules.maps import FAR, NEVER
from pickplace.rules.masks import PlacingMaps
from pickplace.rules.measured_loads import MeasuredLoads
from pickplace.rules.placing import FootprintContact, effector_over_tote, footprint_sizes
from pickplace.rules.state import State, surface_from
from pickplace.rules.support.contact import Patches

DIRECTIONS = 128  # number of directions in which the hull of what supports an item is tested


def level_step(accuracy: int) -> int:
    """Return the greatest difference of measured heights of a level surface: two errors, and a unit for rounding."""
    return 2 * accuracy + 1


def floor_height(accuracy: int) -> int:
    """Return the greatest height that may be measured for the tote's floor."""
    return accuracy + 1


class MeasuredTote(NamedTuple):
    """A tote as it was measured; heights in height units of the cell."""

    highest: Tensor  # int32 [k W_T, k D_T]: greatest height of each patch, rounded up
    lowest: Tensor  # int32 [k W_T, k D_T]: least height, rounded down
    bears: Tensor  # bool [W_T, D_T]: whether a cell bears weight, after the earlier plans
    height: int  # height of the rim, rounded down: no item may be higher
    rim: int  # height of the rim, rounded up: the end effector passes over it
    accuracy: int  # greatest error of a height
    placement_error: float  # greatest distance of an item from where a plan sets it down, in cells

    def state(self, cell: CellSpec, item: Item, slack: int = 0) -> State:
        """Return the state on the grid, with the greatest height of each cell; all heights lowered by ``slack``."""
        patches = self.highest.shape[0] // cell.tote_size[0]
        heights = self.highest.unflatten(0, (-1, patches)).unflatten(2, (-1, patches)).amax((1, 3))
        height = torch.tensor([self.height - slack], device=heights.device)
        surface = surface_from((heights - slack).clamp(min=0), self.bears)
        return State(surface[None], height, item.rows((slice(None), None)))


class MeasuredMaps(NamedTuple):
    """The maps that decide which actions succeed, and why others fail; of one problem."""

    maps: PlacingMaps
    stable: Tensor  # bool [Q, W_T, D_T]
    highest_top: int  # greatest top that does not pass the rim
    effector: EffectorOverTote  # the end effector over every place cell
    borne: Tensor | None = None  # bool [Q, W_T, D_T]: whether the items below bear the item; None: any load


def measured_maps(
    cell: CellSpec, tote: MeasuredTote, item: Item, sides: tuple[float, float], loads: MeasuredLoads | None = None
) -> MeasuredMaps:
    """Return everything that decides which actions succeed in a measured tote.

    An item may be ``accuracy`` higher than measured, and so may what it rests on. So the end effector releases it with
    the suction face twice that above its top, and from there it must clear what is beside the item.

    Args:
        cell: the sizes; heights are in small units, such as millimetres.
        item: of one problem; its width and depth in whole cells, rounded up.
        sides: the item's width and depth, in cells, as measured.
        loads: loads on the items in the tote; None: they bear any.
    """
    slack = tote.accuracy
    z = FootprintContact(cell, tote.state(cell, item).surface, *footprint_sizes(cell, item)).z[..., 0]  # [Q, W_T, D_T]
    stable = torch.stack([_is_stable(cell, tote, item, sides, turned, each) for turned, each in enumerate(z)])
    borne = None
    if loads is not None:
        borne = torch.stack([_is_borne(item, sides, turned, each, loads) for turned, each in enumerate(z)])
    if int(item.w) == int(item.d):  # the masks have one footprint for both turns
        stable = stable.all(0).expand_as(stable)
        borne = None if borne is None else borne.all(0).expand_as(borne)
    top, highest = z + item.h.to(z.dtype), tote.height - 2 * slack
    good = combine(FOOTPRINT, Resting(z < FAR, top, highest, stable, borne))
    effector = effector_over_tote(
        cell, tote.state(cell, item, slack).surface, torch.tensor([tote.rim - 2 * slack], device=z.device)
    )
    maps = PlacingMaps.of(torch.where(good, top, NEVER)[None], z[None], effector, item, None)
    return MeasuredMaps(maps._replace(level_step=level_step(slack)), stable, highest, effector, borne)


def _contact(
    cell: CellSpec, tote: MeasuredTote, footprint: tuple[int, int], sides: tuple[float, float], z: Tensor
) -> Patches:
    """Return the patches that support an item of ``sides``, in the middle of footprints ``[W, D]`` at heights ``z``."""
    count, shape, device = tote.highest.shape[0] // cell.tote_size[0], tuple(z.shape), z.device
    error, sizes = tote.placement_error * count, list(zip(footprint, sides, strict=True))
    spans = [
        (math.ceil((size - side) / 2 * count - 1e-6), math.floor((size + side) / 2 * count + 1e-6))
        for size, side in sizes
    ]
    (x0, x1), (y0, y1) = spans
    near = [torch.arange(begin, max(begin, end), dtype=torch.float64, device=device) for begin, end in spans]
    number = [(part.long() // count) for part in near]
    supports = torch.zeros(*shape, math.prod(map(len, near)), dtype=torch.bool, device=device)
    if supports.numel():  # else the item is narrower than a patch
        under = tote.lowest[x0:, y0:].unfold(0, x1 - x0, count).unfold(1, y1 - y0, count)[: shape[0], : shape[1]]
        # A cell bears weight, or not, as a whole.
        x, y = (torch.arange(size, device=device)[:, None] + part for size, part in zip(shape, number, strict=True))
        bears = tote.bears[x[:, None, :, None], y[None, :, None, :]].flatten(2)
        supports = (under.flatten(2) >= (z - level_step(tote.accuracy))[..., None]) & bears
    angle = torch.arange(DIRECTIONS, dtype=torch.float64, device=device) * (2 * math.pi / DIRECTIONS)
    begins = (part - size * count / 2 for part, size in zip(near, footprint, strict=True))
    along_x, along_y = (
        torch.maximum(begin * direction[:, None], (begin + 1) * direction[:, None])
        for begin, direction in zip(begins, (angle.cos(), angle.sin()), strict=True)
    )
    edges = [(size - side) / 2 * count for size, side in sizes]
    uncovered = [
        torch.stack([edge + error - part, part + 1 - (size * count - edge - error)]).clamp(0, 1).round(decimals=6)
        for part, edge, size in zip(near, edges, footprint, strict=True)
    ]
    # In each half of a side, the part that the item covers whatever the error must contain a whole patch.
    quartered = all(
        math.ceil(size * count / 2 + error - 1e-6) < math.floor((size + side) / 2 * count - error + 1e-6)
        for size, side in sizes
    )
    return Patches(
        supports=supports,
        along=(along_x[:, :, None] + along_y[:, None, :]).flatten(1),
        cells=(number[0][:, None] * footprint[1] + number[1]).flatten(),
        per_cell=count,
        slack=math.hypot(*sides) * count / 2 * math.sin(math.pi / DIRECTIONS),
        touched=math.prod(side * count for side in sides),
        error=error,
        uncovered=(uncovered[0], uncovered[1]),
        quartered=quartered,
    )


def _oriented(
    item: Item, sides: tuple[float, float], quarter_turned: int
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return the footprint's sides in whole cells and the item's own sides, turned or not."""
    footprint = int(item.w), int(item.d)
    return (footprint[::-1], sides[::-1]) if quarter_turned else (footprint, sides)


def _inside(z: Tensor, footprint: tuple[int, int]) -> tuple[slice, slice]:
    """Return the range, in ``[W_T, D_T]``, of places at which a footprint of these sides is inside the tote."""
    wide, deep = (max(0, size - side + 1) for size, side in zip(z.shape, footprint, strict=True))
    return slice(0, wide), slice(0, deep)


def _is_stable(
    cell: CellSpec, tote: MeasuredTote, item: Item, sides: tuple[float, float], quarter_turned: int, z: Tensor
) -> Tensor:
    """Return whether the item, turned or not, is stable on every footprint, bool ``[W_T, D_T]``."""
    footprint, sides = _oriented(item, sides, quarter_turned)
    stable = torch.zeros_like(z, dtype=torch.bool)
    inside = _inside(z, footprint)
    z = z[inside]
    if not z.numel():
        return stable
    contact = _contact(cell, tote, footprint, sides, z)
    on_floor = z <= floor_height(tote.accuracy)  # the one surface that has no gaps
    # By every rule the centre must be above what carries the item.
    stable[inside] = on_floor | contact.full | (contact.is_centre_in_hull() & cell.support.measured(contact))
    return stable


def _is_borne(item: Item, sides: tuple[float, float], quarter_turned: int, z: Tensor, loads: MeasuredLoads) -> Tensor:
    """Return whether the items below bear the item, turned or not, on every footprint, bool ``[W_T, D_T]``."""
    footprint, _ = _oriented(item, sides, quarter_turned)
    borne = torch.zeros_like(z, dtype=torch.bool)
    inside = _inside(z, footprint)
    if (z := z[inside]).numel():
        borne[inside] = loads.can_bear(int(item.grams), footprint, z.long())
    return borne


def bearing_after(
    cell: CellSpec, tote: MeasuredTote, item: Item, sides: tuple[float, float], maps: MeasuredMaps, footprint: int
) -> Tensor:
    """Return a mask of the cells that bear weight once the item lies on a footprint, bool ``[W_T, D_T]``.

    Args:
        footprint: index ``(quarter_turned * W_T + x) * D_T + y``.
    """
    tote_w, tote_d, _ = cell.tote_size
    quarter_turned, x, y = footprint // (tote_w * tote_d), footprint // tote_d % tote_w, footprint % tote_d
    size, sides = _oriented(item, sides, quarter_turned)
    z = maps.maps.rest[0, quarter_turned, x : x + 1, y : y + 1]
    count = tote.highest.shape[0] // tote_w
    shifted = tote._replace(lowest=tote.lowest[x * count :, y * count :], bears=tote.bears[x:, y:])
    contact = _contact(cell, shifted, size, sides, z)
    flags = contact.supports[0, 0]
    held = torch.ones_like(flags)
    if not flags.all() and int(z) > floor_height(tote.accuracy):
        held = contact.hull_mask()
    # A cell bears weight if all of its patches under the item do. With one patch a cell, the item must cover it.
    bears = torch.zeros(size, dtype=torch.bool, device=flags.device)
    bears.view(-1).index_fill_(0, contact.cells, True).index_fill_(0, contact.cells[~held], False)
    after = tote.bears.clone()
    after[x : x + size[0], y : y + size[1]] = bears
    return after


def failures(cell: CellSpec, measured: MeasuredMaps, action: Tensor, bin_clear: Tensor) -> Tensor:
    """Return the failure codes of flat actions, int64 ``[A]``, in the order of the rules' checks.

    Args:
        cell: with the limits of the robot.
        action: int64 ``[A]``.
        bin_clear: bool ``[P]``, whether the end effector hits no wall of the bin at each pick cell.
    """
    item = measured.maps.item.map(lambda part: part.expand(len(action)))
    picked, rotation, effector, placed = carry(cell, item, action)
    x_bin, y_bin, *_ = split_action(cell, action)
    picked = picked._replace(collides=~bin_clear[x_bin * cell.bin_size[1] + y_bin])
    return failure_codes(
        cell, action, item, (picked, rotation, effector, placed),
        measured.maps.rest, measured.stable, measured.highest_top, measured.effector, borne=measured.borne,
    )  # fmt: skip
