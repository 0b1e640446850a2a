"""The planner for a robot cell: depth maps in, one pick and one place out, with the reasons.

Frames of reference (see ``docs/robot.md``): the bin and the tote each have their own. The origin is the outer corner of
cell ``(0, 0)`` on the inner floor; x runs along the first axis of the depth map, y along the second, z upwards. Cell
``(i, j)`` covers ``[i, i + 1) x [j, j + 1)`` cells. A rotation turns the end effector, with the item, counter-clockwise
seen from above.
"""

import os
import reprlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Literal, cast

import numpy as np
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor

from pickplace.planners.policy import PolicyPlanner, restore_policy
from pickplace.policies.actors import Policy
from pickplace.runs import checkpoint
from pickplace.runs.allowlist import trusted_config
from pickplace.runs.machine import usable_device
from pickplace.runs.registry import build
from pickplace.task.geometry import Failure, Item, Rules

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
        """The plan as plain values, ready for JSON."""
        return asdict(self)


class Planner:
    """Plans picks and places for a robot cell with a trained policy.

    Args:
        rules: the cell's sizes and rules.
        policy: a policy of :mod:`pickplace.policies.actors` made for these rules.
        candidates: as in :class:`~pickplace.planners.PolicyPlanner`: ``"all"``, or ``K``.
    """

    def __init__(self, rules: Rules, policy: Policy, candidates: int | Literal["all"] = "all"):
        self.rules, self._planner = rules, PolicyPlanner(rules, policy, candidates)

    @classmethod
    def load(
        cls, path, candidates: int | Literal["all"] = "all", device: str = "cpu", trust: Sequence[str] = (), **sizes
    ) -> "Planner":
        """A planner from a checkpoint.

        Args:
            path: a run folder, a checkpoint, or ``pretrained/<name>``.
            candidates: ``"all"``, or ``K``: how many of the most probable actions are tried.
            device: where to compute, ``"cpu"`` or ``"cuda"``.
            trust: modules of your own that the checkpoint's config may make classes of, beside pickplace's own.
            **sizes: what differs from the training's settings, such as ``tote_size=(30, 30, 10)``; see
                :class:`~pickplace.task.geometry.Rules`. The policy serves any bin and tote, and if it was trained
                with a mask any end effector.

        Raises:
            ValueError: for a checkpoint that cannot be used, or bad sizes.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise ValueError(f"path={path!r}: expected a run folder, a checkpoint, or pretrained/<name>.")
        state, facts = checkpoint.read(checkpoint.locate(path))
        cfg = trusted_config(facts["config"], trust)
        known = {field.name for field in fields(Rules)}
        if unknown := sorted(set(sizes) - known):
            raise ValueError(f"{unknown[0]}={sizes[unknown[0]]!r}: expected one of {', '.join(sorted(known))}.")
        env = cast(dict, OmegaConf.to_container(cfg.env, resolve=True))
        trained = {key: value for key, value in env.items() if key in known}
        rules = Rules(**{**trained, **sizes})
        if rules.pick_rule == "overlap" and rules.longest_side is None:  # then the number of grasps depends on it
            longest = int(build("items", cfg["items"]).sizes[:, :2].max())
            rules = replace(rules, longest_side=longest)
        policy = restore_policy(cfg, rules, state["policy"], env)
        return cls(rules, policy.to(usable_device(device)), candidates)

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
        """Where to pick, where to place and how to turn the one item in the bin.

        Args:
            bin_depth: ``[W_B, D_B]``, height above the bin's floor in each cell, 0 where empty; numpy, torch or lists.
            tote_depth: ``[W_T, D_T]``, remaining height in each cell: from the surface up to the rim.
            tote_height: height of the tote's rim above its floor; None: the one of ``rules.tote_size``.
            cell_size: side of a cell in metres, if the maps and ``tote_height`` are in metres; None: they are in cells.
            tolerance: how far, in cells, a measured height may be from a whole number of cells; below 0.5.
            alternatives: how many of the most probable choices to report, and the chosen one if it is further down;
                0 is fastest. Where nothing is feasible it takes longest: all actions are simulated for the reasons.

        Raises:
            DepthMapError: for a map of another shape or type, a value that is not finite, out of range or too far from
                a whole number of cells, no item, or something in the bin that is not one cuboid; it names the cell.
        """
        rules, unit = self.rules, 1.0
        if cell_size is not None:
            unit = _number("cell_size", cell_size, "a length in metres, 1e-6 to 1e6", lambda v: 1e-6 <= v <= 1e6)
        tolerance = _number("tolerance", tolerance, "a number of cells >= 0 and < 0.5", lambda v: 0 <= v < 0.5)
        if isinstance(alternatives, bool) or not isinstance(alternatives, (int, np.integer)) or alternatives < 0:
            raise DepthMapError(f"alternatives={reprlib.repr(alternatives)}: expected a whole number >= 0.")
        height = rules.tote_size[2]
        if tote_height is not None:
            wanted = f"a whole number of cells, 1 to {2**20 - 1}, within {tolerance:g}" + ", in metres" * (unit != 1.0)

            def good(length):  # the range first: far beyond it nothing can be rounded
                cells = length / unit
                return 0.5 < cells < 2**20 - 0.5 and abs(cells - round(cells)) <= tolerance + ROUNDING

            height = round(_number("tote_height", tote_height, wanted, good) / unit)
        bin_map = _snap("bin_depth", bin_depth, rules.bin_size[:2], unit, tolerance, 2**20)
        tote_map = _snap("tote_depth", tote_depth, rules.tote_size[:2], unit, tolerance, height)
        _refuse_other_than_one_cuboid(bin_map)
        if (
            rules.pick_rule == "overlap"
            and max((bin_map > 0).sum(0).max(), (bin_map > 0).sum(1).max()) > rules.max_side
        ):
            raise DepthMapError(
                f"bin_depth: the item is longer than any in training, expected at most {rules.max_side}."
            )

        device = next(self._planner.policy.parameters()).device
        observation = TensorDict(
            {
                "bin_depth": bin_map.float()[None],
                "tote_depth": tote_map.float()[None],
                "tote_height": torch.tensor([[height]]),
            },
            batch_size=[1],
            device=device,
        )
        heights = (height - tote_map)[None].int().to(device)
        item = rules.read_item(observation["bin_depth"])
        at = torch.tensor([height], device=device)
        action, reasons = None, None  # an action that succeeds; why none does
        if _any_feasible(rules, heights, at, item):
            status = "rejected"
            decided = self._planner.decide(observation)
            step = rules.apply(heights, at, item, decided)
            if int(step.failure[0]) == 0:
                action, status = decided, "ok"
        else:
            status = "stuck" if _any_feasible(rules, torch.zeros_like(heights), at, item) else "impossible"
            reasons = self._reasons(heights, at, item)

        capacity = height * rules.num_places
        before = int(heights.sum()) / capacity
        volume = int(item.w * item.d * item.h)
        plan = Plan(
            status=status,
            item={key: int(value) for key, value in item._asdict().items()},
            pick=None,
            place=None,
            rotation_degrees=None,
            drop_height=None,
            action=None,
            occupancy_before=before,
            occupancy_after=before if action is None else before + volume / capacity,
            alternatives=self._alternatives(observation, heights, at, item, action, alternatives),
            reasons=reasons,
        )
        if action is None:
            return plan
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in rules.split_action(action))
        ee_w, ee_d = rules.effector_size
        turned_w, turned_d, ref_x, ref_y = rules.effectors[rotation % 2]
        top = int(step.top[0])

        def length(cells: float) -> float:
            return round(cells * unit, 9)  # without the tail of binary fractions

        # The centre comes from the rectangle, not from the reference cell, which is off by half a cell on even sides.
        left, front = x_bin - (ee_w - 1) // 2, y_bin - (ee_d - 1) // 2
        pick = length(left + ee_w / 2), length(front + ee_d / 2), length(plan.item["h"])
        place = length(x_tote - ref_x + turned_w / 2), length(y_tote - ref_y + turned_d / 2), length(top)
        return replace(
            plan,
            pick=Pose((x_bin, y_bin), pick),
            place=Pose((x_tote, y_tote), place),
            rotation_degrees=90 * rotation,
            drop_height=length(top - plan.item["h"]),
            action=int(action),
        )

    def _alternatives(self, observation, heights, tote_height, item, chosen, count) -> list[Alternative]:
        """The most probable choices, in the order in which the planner prefers them."""
        if count == 0:
            return []
        rules, planner = self.rules, self._planner
        log_probs = planner.policy.action_log_probs(observation["bin_depth"], observation["tote_depth"])[0]
        if planner.candidates == "all" and planner.policy.choice_key == "outcome":
            actions, probability = self._footprints(log_probs, heights, tote_height, item, chosen, count)
        else:
            tried = rules.num_actions if planner.candidates == "all" else min(planner.candidates, rules.num_actions)
            actions = log_probs.topk(tried).indices[:count]  # the same call as the planner's: ties fall alike
            if chosen is not None and not (actions == chosen).any():
                actions = torch.cat([actions, chosen])
            probability = log_probs[actions].exp()
        failure = self._simulate(heights, tote_height, item, actions)
        columns = [column.tolist() for column in rules.split_action(actions)]
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

    def _footprints(self, log_probs, heights, tote_height, item, chosen, count) -> tuple[Tensor, Tensor]:
        """An action for each of the most probable footprints in the tote, and the footprint's probability.

        Many actions leave the same footprint, and the policy does not tell them apart. A footprint is shown by the
        chosen action, by its first feasible one, or by its first one if all fail.
        """
        rules = self.rules
        outcome = rules.action_outcomes(item)[0]  # [N_a]
        feasible = rules.action_mask(rules.placements(heights, tote_height, item))[0]
        lands = outcome >= 0
        total = log_probs.new_zeros(rules.num_outcomes)
        total.scatter_add_(0, outcome[lands], log_probs[lands].exp())
        reachable = torch.zeros_like(total, dtype=torch.bool).index_fill_(0, outcome[lands], True)
        ranked = torch.where(reachable, total, -1).argsort(descending=True, stable=True)[: int(reachable.sum())][:count]
        if chosen is not None and not (ranked == outcome[chosen]).any():
            ranked = torch.cat([ranked, outcome[chosen]])
        preference = feasible.int()
        if chosen is not None:
            preference[chosen] = 2
        shown = [torch.where(outcome == footprint, preference, -1).argmax() for footprint in ranked]
        return torch.stack(shown) if shown else ranked, total[ranked]

    def _simulate(self, heights, tote_height, item, actions) -> Tensor:
        """Failure codes of many actions in one state, int64 ``[A]``."""
        codes = []
        for part in actions.split(4096):  # a few thousand at a time, for the memory's sake
            count = len(part)
            many = Item(*(value.expand(count) for value in item))
            step = self.rules.apply(heights.expand(count, -1, -1), tote_height.expand(count), many, part)
            codes.append(step.failure)
        return torch.cat(codes)

    def _reasons(self, heights, tote_height, item) -> dict[str, int]:
        """How many of all flat actions fail for which reason."""
        codes = self._simulate(heights, tote_height, item, torch.arange(self.rules.num_actions, device=heights.device))
        counts = codes.bincount(minlength=len(Failure)).tolist()
        return {failure.name.lower(): counts[failure] for failure in Failure if counts[failure]}


def _any_feasible(rules: Rules, heights: Tensor, tote_height: Tensor, item: Item) -> bool:
    """Can anything be done with the item in this tote?"""
    return bool(rules.outcome_mask(rules.placements(heights, tote_height, item)).any())


def _number(name: str, value, wanted: str, good) -> float:
    """A finite number for which ``good`` holds."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, (bool, np.bool_, str, bytes)) or not abs(number) < float("inf") or not good(number):
        raise DepthMapError(f"{name}={reprlib.repr(value)}: expected {wanted}.")
    return number


def _snap(name: str, values, grid: tuple[int, int], unit: float, tolerance: float, highest: int) -> Tensor:
    """A measured map as whole cells, int64 ``grid``, each value between 0 and ``highest``."""
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
    """The bin must show one cuboid: its bounding box filled at one height."""
    if not (bin_map > 0).any():
        raise DepthMapError("bin_depth: got no cell above 0, expected one item.")
    x, y, w, d, h = (int(value) for value in Rules.read_item(bin_map[None].float()))
    box = bin_map[x : x + w, y : y + d]
    if (box != h).any():
        i, j = (box != h).nonzero()[0].tolist()
        raise DepthMapError(
            f"bin_depth[{x + i}, {y + j}]: got {int(box[i, j])} cells, expected {h}: one cuboid that fills its "
            f"bounding box, {w}x{d} cells from [{x}, {y}]."
        )
