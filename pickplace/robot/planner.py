"""The planner for a robot cell: depth maps in, one pick and one place out, with the reasons.

Frames of reference (see ``docs/robot.md``): the bin and the tote each have their own. The origin is the outer corner of
cell ``(0, 0)`` on the inner floor; x runs along the first axis of the depth map, y along the second, z upwards. Cell
``(i, j)`` covers ``[i, i + 1) x [j, j + 1)`` cells. A rotation turns the end effector, with the item, counter-clockwise
seen from above.
"""

import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, cast

import numpy as np
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor

from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import Policy
from pickplace.policies.restore import restore_policy
from pickplace.runs import checkpoint
from pickplace.runs.allowlist import trusted_config
from pickplace.runs.machine import usable_device
from pickplace.runs.registry import build
from pickplace.task.cell import CELL_SETTINGS, CellSpec, cell_from_settings, reference_cell
from pickplace.task.checks import is_whole
from pickplace.task.feasibility import action_footprints, action_mask, footprint_mask, placing_maps
from pickplace.task.grasps import split_action
from pickplace.task.maps import FAR
from pickplace.task.observation import Term, check_terms, observe
from pickplace.task.state import Failure, State, heights_from_depth, item_from_depth
from pickplace.task.transition import Step, apply

#: Beyond the tolerance, in cells: three cells of 0.05 m are not exactly 0.15 m in binary fractions.
ROUNDING = 1e-6


class DepthMapError(ValueError):
    """A depth map, or what comes with it, that cannot be planned with; the message is one sentence."""


@dataclass(frozen=True)
class Pose:
    """Where the end effector goes, in the frame of the bin or of the tote."""

    cell: tuple[int, int]  #: grid cell of the end effector's reference cell
    center: tuple[float, float, float]  #: centre of its suction face: x, y, z; in metres if `cell_size` was given


@dataclass(frozen=True)
class Alternative:
    """One of the most probable choices, and what a forward simulation says of it."""

    action: int  #: flat index
    pick_cell: tuple[int, int]
    place_cell: tuple[int, int]
    rotation_degrees: int
    probability: float  #: that the policy gives, without a mask: of the action, or the footprint if it chooses one
    rejected: str | None  #: why it would fail; None if it would succeed
    chosen: bool


@dataclass(frozen=True)
class Plan:
    """What to do with the item that lies in the bin; made by :meth:`Planner.plan`.

    Lengths are in metres if ``cell_size`` was given, else in cells; ``item`` and the ``cell`` of a pose are in cells.
    """

    #: "ok"; "stuck": nothing at all is feasible; "impossible": nor would it be in an empty tote; "rejected": something
    #: is feasible, but not what the policy would do
    status: str
    item: dict[str, int]  #: the item seen in the bin: x, y, w, d, h
    pick: Pose | None  #: in the bin's frame; z is the item's top
    place: Pose | None  #: in the tote's frame; z is the item's top once it rests
    rotation_degrees: int | None  #: counter-clockwise seen from above, between pick and place
    drop_height: float | None  #: height of the item's underside above the tote's floor once it rests
    action: int | None  #: flat index
    occupancy_before: float  #: share of the tote's volume below the surface that the depth map shows, 0 to 1
    occupancy_after: float
    alternatives: list[Alternative]  #: the most probable choices, best first
    reasons: dict[str, int] | None  #: if stuck or impossible: how many of all flat actions fail for which reason

    def as_dict(self) -> dict:
        """Return the plan as plain values, ready for JSON."""
        return asdict(self)


class Planner:
    """Plans picks and places for a robot cell with a trained policy.

    Args:
        cell: the cell's sizes and options.
        policy: a policy made for this cell.
        candidates: as in :class:`~pickplace.planners.policy.PolicyPlanner`: ``"all"``, or ``K``.
        terms: of the observation, by key; None: the standard ones.
    """

    def __init__(
        self,
        cell: CellSpec,
        policy: Policy,
        candidates: int | Literal["all"] = "all",
        terms: Mapping[str, Term] | None = None,
    ):
        self.cell, self.terms = cell, check_terms(terms)
        self._planner = PolicyPlanner(cell, policy, candidates)

    @classmethod
    def load(
        cls, path, candidates: int | Literal["all"] = "all", device: str = "cpu", trust: Sequence[str] = (), **sizes
    ) -> "Planner":
        """Return a planner from a checkpoint.

        Args:
            path: a run folder, a checkpoint, or ``pretrained/<name>``.
            candidates: ``"all"``, or ``K``: how many of the most probable actions are tried.
            device: where to compute, ``"cpu"`` or ``"cuda"``.
            trust: modules of your own that the checkpoint's config may make classes of, beside pickplace's own.
            **sizes: settings that differ from the training's, such as ``tote_size=(30, 30, 10)``; see
                :class:`~pickplace.task.cell.CellSpec`. The policy serves any bin and tote, and if it was trained with a
                mask any end effector.

        Raises:
            ValueError: for a checkpoint that cannot be used, or bad sizes.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise ValueError(f"path={path!r}: expected a run folder, a checkpoint, or pretrained/<name>.")
        state, facts = checkpoint.read(checkpoint.locate(path))
        cfg = trusted_config(facts["config"], trust)
        if unknown := sorted(set(sizes) - set(CELL_SETTINGS) - {"longest_side", "limits"}):
            raise ValueError(f"{unknown[0]}={sizes[unknown[0]]!r}: expected one of {', '.join(CELL_SETTINGS)}.")
        env = cast(dict, OmegaConf.to_container(cfg.env, resolve=True))
        cell = cell_from_settings({**{key: env[key] for key in CELL_SETTINGS if key in env}, **sizes})
        if cell.pick_rule == "overlap" and cell.longest_side is None:  # then the number of grasps depends on it
            longest = int(build("items", cfg["items"]).sizes[:, :2].max())
            cell = replace(cell, longest_side=longest)
        policy = restore_policy(cfg, cell, state["policy"], env)
        terms = {str(key): build(f"env.observation.{key}", node) for key, node in cfg.env.observation.items()}
        return cls(cell, policy.to(usable_device(device)), candidates, terms)

    @torch.inference_mode()
    def plan(
        self,
        bin_depth,
        tote_depth,
        tote_height=None,
        cell_size: float | None = None,
        tolerance: float = 0.25,
        alternatives: int = 10,
    ) -> Plan:
        """Return where to pick, where to place and how to turn the one item in the bin.

        Args:
            bin_depth: ``[W_B, D_B]``, height above the bin's floor in each cell, 0 where empty; numpy, torch or lists.
            tote_depth: ``[W_T, D_T]``, remaining height in each cell: from the surface up to the rim.
            tote_height: height of the tote's rim above its floor; None: the one of ``cell.tote_size``.
            cell_size: side of a cell in metres, if the maps and ``tote_height`` are in metres; None: they are in height
                units of the cell.
            tolerance: how far, in height units, a measured height may be from a whole number of them; below 0.5.
            alternatives: how many of the most probable choices to report, and the chosen one if it is further down;
                0 is fastest. Where nothing is feasible it takes longest: all actions are simulated for the reasons.

        Raises:
            DepthMapError: for a map of another shape or type, a value that is not finite, out of range or too far from
                a whole number of cells, no item, or something in the bin that is not one cuboid; it names the cell.
        """
        lengths = _Lengths(self.cell, cell_size)
        tolerance = _number("tolerance", tolerance, "a number of cells >= 0 and < 0.5", lambda v: 0 <= v < 0.5)
        if not is_whole(alternatives) or alternatives < 0:
            raise DepthMapError(f"alternatives={reprlib.repr(alternatives)}: expected a whole number >= 0.")
        state = self._read_state(bin_depth, tote_depth, tote_height, lengths, tolerance)
        observation = TensorDict(observe(self.terms, self.cell, state), [1], device=state.heights.device)
        status, action, step, reasons = self._decide(observation, state)
        height = int(state.tote_height)
        capacity = height * self.cell.num_places
        before = int(state.heights.sum()) / capacity
        plan = Plan(
            status=status,
            item={key: int(value) for key, value in state.item._asdict().items()},
            pick=None,
            place=None,
            rotation_degrees=None,
            drop_height=None,
            action=None,
            occupancy_before=before,
            occupancy_after=before if action is None else before + int(state.item.volume) / capacity,
            alternatives=self._alternatives(observation, state, action, alternatives),
            reasons=reasons,
        )
        return plan if action is None or step is None else self._add_poses(plan, action, step, lengths)

    def _read_state(self, bin_depth, tote_depth, tote_height, lengths: "_Lengths", tolerance: float) -> State:
        """Return the state that measured maps show; arguments and errors as of :meth:`plan`."""
        cell, unit = self.cell, lengths.height_unit
        height = cell.tote_size[2]
        if tote_height is not None:
            wanted = f"a whole number of cells, 1 to {FAR - 1}, within {tolerance:g}" + ", in metres" * lengths.metric

            def is_good(length):  # the range first: far beyond it nothing can be rounded
                units = length / unit
                return 0.5 < units < FAR - 0.5 and abs(units - round(units)) <= tolerance + ROUNDING

            height = round(_number("tote_height", tote_height, wanted, is_good) / unit)
        bin_map = _snap("bin_depth", bin_depth, cell.bin_size[:2], unit, tolerance, FAR)
        tote_map = _snap("tote_depth", tote_depth, cell.tote_size[:2], unit, tolerance, height)
        _refuse_other_than_one_cuboid(bin_map)
        longest = max((bin_map > 0).sum(0).max(), (bin_map > 0).sum(1).max())
        if cell.pick_rule == "overlap" and longest > cell.max_side:
            raise DepthMapError(
                f"bin_depth: the item is longer than any in training, expected at most {cell.max_side}."
            )
        device = next(self._planner.policy.parameters()).device
        rim = torch.tensor([height], device=device)
        item = item_from_depth(bin_map.float()[None].to(device))
        return State(heights_from_depth(tote_map[None].to(device), rim), rim, item)

    def _decide(self, observation, state: State) -> tuple[str, Tensor | None, Step | None, dict[str, int] | None]:
        """Return the status, an action that succeeds with its effect, and the reasons why nothing does."""
        if _any_feasible(self.cell, state):
            decided = self._planner.decide(observation)
            step = apply(self.cell, state, decided)
            return ("ok", decided, step, None) if int(step.failure[0]) == 0 else ("rejected", None, None, None)
        empty = state._replace(heights=torch.zeros_like(state.heights))
        status = "stuck" if _any_feasible(self.cell, empty) else "impossible"
        return status, None, None, self._reasons(state)

    def _add_poses(self, plan: Plan, action: Tensor, step: Step, lengths: "_Lengths") -> Plan:
        """Return the plan with the poses of a successful action."""
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in split_action(self.cell, action))
        ee_w, ee_d = self.cell.effector_size
        turned = self.cell.effectors[rotation % 2]
        top = int(step.top[0])
        # The centre comes from the rectangle, not from the reference cell, which is off by half a cell on even sides.
        left, front = x_bin - reference_cell(ee_w), y_bin - reference_cell(ee_d)
        pick = lengths.across(left + ee_w / 2), lengths.across(front + ee_d / 2), lengths.up(plan.item["h"])
        x, y = x_tote - turned.ref_x + turned.width / 2, y_tote - turned.ref_y + turned.depth / 2
        place = lengths.across(x), lengths.across(y), lengths.up(top)
        return replace(
            plan,
            pick=Pose((x_bin, y_bin), pick),
            place=Pose((x_tote, y_tote), place),
            rotation_degrees=90 * rotation,
            drop_height=lengths.up(top - plan.item["h"]),
            action=int(action),
        )

    def _alternatives(self, observation, state: State, chosen: Tensor | None, count: int) -> list[Alternative]:
        """Return the most probable choices, in the order in which the planner prefers them."""
        if count == 0:
            return []
        cell, planner = self.cell, self._planner
        log_probs = planner.policy.action_log_probs(observation)[0]
        if planner.candidates == "all" and planner.policy.ranks_footprints:
            actions, probability = self._footprints(log_probs, state, chosen, count)
        else:
            tried = cell.num_actions if planner.candidates == "all" else min(planner.candidates, cell.num_actions)
            actions = log_probs.topk(tried).indices[:count]  # the same call as the planner's, so that ties agree
            if chosen is not None and not (actions == chosen).any():
                actions = torch.cat([actions, chosen])
            probability = log_probs[actions].exp()
        failure = self._simulate(state, actions)
        columns = [column.tolist() for column in split_action(cell, actions)]
        return [
            Alternative(
                action=action,
                pick_cell=(x_bin, y_bin),
                place_cell=(x_tote, y_tote),
                rotation_degrees=90 * rotation,
                probability=share,
                rejected=Failure(code).name.lower() if code else None,
                chosen=chosen is not None and action == int(chosen),
            )
            for action, x_bin, y_bin, x_tote, y_tote, rotation, share, code in zip(
                actions.tolist(), *columns, probability.tolist(), failure.tolist(), strict=True
            )
        ]

    def _footprints(self, log_probs: Tensor, state: State, chosen: Tensor | None, count: int) -> tuple[Tensor, Tensor]:
        """Return an action for each of the most probable footprints, and the footprint's probability.

        Many actions leave the same footprint, and the policy does not tell them apart. A footprint is shown by the
        chosen action, by its first feasible one, or by its first one if all fail.
        """
        cell = self.cell
        footprint = action_footprints(cell, state.item)[0]  # [N_a]
        feasible = action_mask(cell, placing_maps(cell, state))[0]
        lands = footprint >= 0
        total = log_probs.new_zeros(cell.num_footprints)
        total.scatter_add_(0, footprint[lands], log_probs[lands].exp())
        reachable = torch.zeros_like(total, dtype=torch.bool).index_fill_(0, footprint[lands], True)
        ranked = torch.where(reachable, total, -1).argsort(descending=True, stable=True)[: int(reachable.sum())][:count]
        if chosen is not None and not (ranked == footprint[chosen]).any():
            ranked = torch.cat([ranked, footprint[chosen]])
        preference = feasible.int()
        if chosen is not None:
            preference[chosen] = 2
        shown = [torch.where(footprint == wanted, preference, -1).argmax() for wanted in ranked]
        return torch.stack(shown) if shown else ranked, total[ranked]

    def _simulate(self, state: State, actions: Tensor) -> Tensor:
        """Return the failure codes of many actions in one state, int64 ``[A]``."""
        parts = actions.split(4096)  # a few thousand at a time, for the memory's sake
        return torch.cat([apply(self.cell, state.repeat(len(part)), part).failure for part in parts])

    def _reasons(self, state: State) -> dict[str, int]:
        """Return how many of all flat actions fail for which reason."""
        codes = self._simulate(state, torch.arange(self.cell.num_actions, device=state.heights.device))
        counts = codes.bincount(minlength=len(Failure)).tolist()
        return {failure.name.lower(): counts[failure] for failure in Failure if counts[failure]}


class _Lengths:
    """Conversion of cells and height units to the lengths of a plan: metres if ``cell_size`` is given."""

    def __init__(self, cell: CellSpec, cell_size: float | None):
        self.metric = cell_size is not None
        self.cell_size = 1.0
        if cell_size is not None:
            wanted = "a length in metres, 1e-6 to 1e6"
            self.cell_size = _number("cell_size", cell_size, wanted, lambda v: 1e-6 <= v <= 1e6)
        self.height_unit = self.cell_size * (cell.height_unit if self.metric else 1.0)

    def across(self, cells: float) -> float:
        """Return a length along x or y."""
        return round(cells * self.cell_size, 9)  # without the tail of binary fractions

    def up(self, units: float) -> float:
        """Return a height."""
        return round(units * self.height_unit, 9)


def _any_feasible(cell: CellSpec, state: State) -> bool:
    """Return whether anything can be done with the item in this tote."""
    return bool(footprint_mask(cell, placing_maps(cell, state)).any())


def _number(name: str, value, wanted: str, good) -> float:
    """Return a finite number for which ``good`` holds."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, (bool, np.bool_, str, bytes)) or not abs(number) < float("inf") or not good(number):
        raise DepthMapError(f"{name}={reprlib.repr(value)}: expected {wanted}.")
    return number


def _snap(name: str, values, grid: tuple[int, int], unit: float, tolerance: float, highest: int) -> Tensor:
    """Return a measured map in whole height units, int64 ``grid``, each value between 0 and ``highest``."""
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu()
            values = values.float() if values.dtype == torch.bfloat16 else values  # which numpy does not have
        array = np.asarray(values)  # of a masked array what is under the mask, too
    except (TypeError, ValueError) as error:
        raise DepthMapError(f"{name}: expected an array of {grid[0]}x{grid[1]} numbers ({error}).") from error
    if array.shape != tuple(grid):
        raise DepthMapError(
            f"{name}: got shape {list(array.shape)}, expected {list(grid)}, the grid that the planner was loaded for."
        )
    if array.dtype.kind not in "iuf":
        raise DepthMapError(f"{name}: got values of type {array.dtype}, expected numbers.")
    if isinstance(values, np.ma.MaskedArray) and np.ma.getmaskarray(values).any():
        x, y = np.argwhere(np.ma.getmaskarray(values))[0].tolist()
        raise DepthMapError(f"{name}[{x}, {y}]: got a masked value, expected a measured one.")
    with np.errstate(all="ignore"):
        cells = array.astype(np.float64) / unit
        whole = np.round(cells)
        fine = np.finfo(array.dtype if array.dtype.kind == "f" else float).eps  # of metres that are float32, too
        far = ~(np.abs(cells - whole) <= tolerance + ROUNDING + fine * np.abs(cells))  # also where it is not a number
    out = ~((whole >= 0) & (whole <= highest))
    if (far | out).any():
        x, y = np.argwhere(far | out)[0].tolist()
        value = f"{cells[x, y]:g} cells" + (f" ({array[x, y]:g} m)" if unit != 1 else "")
        wanted = f"a whole number of cells, within {tolerance:g}" if far[x, y] else f"0 to {highest} cells"
        raise DepthMapError(f"{name}[{x}, {y}]: got {value}, expected {wanted}.")
    return torch.from_numpy(whole.astype(np.int64))


def _refuse_other_than_one_cuboid(bin_map: Tensor) -> None:
    """Refuse a bin that does not show one cuboid: its bounding box filled at one height."""
    if not (bin_map > 0).any():
        raise DepthMapError("bin_depth: got no cell above 0, expected one item.")
    x, y, w, d, h = (int(value) for value in item_from_depth(bin_map[None].float()))
    box = bin_map[x : x + w, y : y + d]
    if (box != h).any():
        i, j = (box != h).nonzero()[0].tolist()
        raise DepthMapError(
            f"bin_depth[{x + i}, {y + j}]: got {int(box[i, j])} cells, expected {h}: one cuboid that fills its "
            f"bounding box, {w}x{d} cells from [{x}, {y}]."
        )
