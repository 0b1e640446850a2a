"""The planner for a robot cell: from depth maps to one pick and one place, with reasons where there is none.

Frames of reference (see ``docs/robot.md``): the bin and the tote have a frame each. The origin is the outer corner of
cell ``(0, 0)`` on the inner floor; x runs along the first axis of the depth map, y along the second, z upwards. Cell
``(i, j)`` covers ``[i, i + 1) x [j, j + 1)`` cells. A rotation turns the end effector, with the item, counter-clockwise
seen from above.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from pickplace.planners.base import decide
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import Policy
from pickplace.policies.restore import load_policy
from pickplace.robot.depth_maps import DepthMapError, Lengths, check_one_cuboid, flags_of_map
from pickplace.task.cell import CellSpec, reference_cell
from pickplace.task.checks import excerpt, is_whole
from pickplace.task.feasibility import action_footprints, action_mask, footprint_mask, placing_maps
from pickplace.task.grasps import split_action
from pickplace.task.maps import FAR
from pickplace.task.observation import Term, check_terms, observe
from pickplace.task.state import EMPTY, Failure, State
from pickplace.task.transition import Step, apply

MAX_ALTERNATIVES = 100_000  # greatest number of choices that a plan may report


@dataclass(frozen=True)
class Pose:
    """Pose of the end effector, in the frame of the bin or of the tote."""

    cell: tuple[int, int]  #: grid cell of the end effector's reference cell
    center: tuple[float, float, float]  #: centre of its suction face: x, y, z


@dataclass(frozen=True)
class Alternative:
    """One of the most probable choices, and whether it succeeds in a forward simulation."""

    action: int  #: flat index
    pick_cell: tuple[int, int]
    place_cell: tuple[int, int]
    rotation_degrees: int
    probability: float  #: of the action, or of the footprint if the policy chooses footprints; without a mask
    rejected: str | None  #: the reason why it would fail; None if it would succeed
    chosen: bool


@dataclass(frozen=True)
class Plan:
    """One pick and one place for the item in the bin; made by :meth:`Planner.plan`.

    The lengths ``center`` and ``drop_height`` are in metres if ``cell_size`` was given, else in cells along x and y and
    in height units along z.
    """

    #: "ok"; "stuck": no action is feasible; "impossible": no action would be feasible in an empty tote either;
    #: "rejected": some action is feasible, but not the one that the policy chooses
    status: str
    item: dict[str, int]  #: the item seen in the bin: x, y, w, d in cells, h in height units
    pick: Pose | None  #: in the bin's frame; z is the item's top
    place: Pose | None  #: in the tote's frame; z is the item's top once it rests
    rotation_degrees: int | None  #: counter-clockwise seen from above, between pick and place
    drop_height: float | None  #: height of the item's underside above the tote's floor once it rests
    action: int | None  #: flat index
    occupancy_before: float  #: share of the tote's volume below the surface that the depth map shows, 0 to 1
    occupancy_after: float
    alternatives: list[Alternative]  #: the most probable choices, best first
    reasons: dict[str, int] | None  #: if stuck or impossible: how many of all flat actions fail for each reason
    #: with ``support="bearing"``: 1 where the tote bears weight once the item rests, for the next call; else None
    tote_bearing: list[list[int]] | None

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
            path, device, trust, **sizes: see :func:`~pickplace.policies.restore.load_policy`, as for errors.
            candidates: ``"all"``, or ``K``: how many of the most probable actions are tried.
        """
        trained = load_policy(path, device, trust, **sizes)
        return cls(trained.cell, trained.policy, candidates, trained.terms)

    @torch.inference_mode()
    def plan(
        self,
        bin_depth,
        tote_depth,
        tote_height=None,
        cell_size: float | None = None,
        tolerance: float = 0.25,
        alternatives: int = 10,
        tote_bearing=None,
    ) -> Plan:
        """Return where to pick the one item in the bin, where to place it and how to turn it.

        Args:
            bin_depth: ``[W_B, D_B]``, height above the bin's floor in each cell, 0 where empty; numpy, torch or lists.
            tote_depth: ``[W_T, D_T]``, remaining height in each cell: from the surface up to the rim.
            tote_height: height of the tote's rim above its floor; None: that of ``cell.tote_size``.
            cell_size: side of a cell in metres, if the maps and ``tote_height`` are in metres; None: they are in height
                units of the cell.
            tolerance: how far, in height units, a measured height may be from a whole number of them; below 0.5.
            alternatives: how many of the most probable choices to report, and the chosen one if it is further down;
                0 is fastest. Where no action is feasible, planning takes longest: all are simulated for the reasons.
            tote_bearing: with ``support="bearing"``, ``[W_T, D_T]``, 1 where a cell bears weight, else 0: what the
                plan before this one returned; None: every cell bears weight.

        Raises:
            DepthMapError: for a map of another shape or type, a value that is not finite, out of range or too far from
                a whole number of height units, an empty bin, or anything but one cuboid in it; it names the cell.
        """
        lengths, height = self.check_settings(tote_height, cell_size, tolerance, alternatives)
        state = self._read_state(bin_depth, tote_depth, tote_bearing, height, lengths)
        observation = observe(self.terms, self.cell, state)
        status, action, step = self._decide(observation, state)
        capacity = self.cell.tote_volume(int(state.tote_height))
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
            reasons=self._reasons(state) if status in ("stuck", "impossible") else None,
            tote_bearing=self._bearing(state if step is None else state._replace(surface=step.surface)),
        )
        return plan if action is None or step is None else self._add_poses(plan, action, step, lengths)

    def check_settings(self, tote_height, cell_size, tolerance, alternatives) -> tuple[Lengths, int]:
        """Return the conversion of lengths and the tote's height in height units; arguments as of :meth:`plan`.

        Raises:
            DepthMapError: naming the argument that is out of range.
        """
        lengths = Lengths(self.cell, cell_size, tolerance)
        if not is_whole(alternatives) or not 0 <= alternatives <= MAX_ALTERNATIVES:
            expected = f"expected a whole number >= 0 and <= {MAX_ALTERNATIVES:,}."
            raise DepthMapError(f"alternatives={excerpt(alternatives)}: {expected}")
        return lengths, self.cell.tote_size[2] if tote_height is None else lengths.units_of_tote_height(tote_height)

    def _read_state(self, bin_depth, tote_depth, tote_bearing, height: int, lengths: Lengths) -> State:
        """Return the state that measured maps show; ``height`` is the tote's, in height units."""
        cell = self.cell
        bin_map = lengths.units_of_map("bin_depth", bin_depth, cell.bin_size[:2], FAR)
        tote_map = lengths.units_of_map("tote_depth", tote_depth, cell.tote_size[:2], height)
        check_one_cuboid(bin_map, lengths.unit_name)
        longest = int(max((bin_map > 0).sum(0).max(), (bin_map > 0).sum(1).max()))
        if cell.pick_rule == "overlap" and longest > cell.max_side:
            raise DepthMapError(
                f"bin_depth: the item is {longest} cells long, longer than any in training; expected at most "
                f"{cell.max_side}."
            )
        bearing = torch.ones_like(tote_map)
        if tote_bearing is not None:
            bearing = flags_of_map("tote_bearing", tote_bearing, cell.tote_size[:2])
            bearing = torch.where(tote_map == height, 1, bearing)  # the floor bears weight; this may be another tote
            if cell.support != "bearing" and not bearing.all():
                raise DepthMapError(f"tote_bearing: got a 0 with support={cell.support}, expected support=bearing.")
        device = next(self._planner.policy.parameters()).device
        measured = {"bin_depth": bin_map.float(), "tote_depth": tote_map, "tote_bearing": bearing}
        measured["tote_height"] = torch.tensor(height)
        return State.from_observation({key: value[None].to(device) for key, value in measured.items()})

    def _bearing(self, state: State) -> list[list[int]] | None:
        """Return where the tote bears weight, if the rule asks for it."""
        return state.bearing[0].int().tolist() if self.cell.support == "bearing" else None

    def _decide(self, observation, state: State) -> tuple[str, Tensor | None, Step | None]:
        """Return the status, and if an action was found that succeeds, the action and its effect."""
        if _any_feasible(self.cell, state):
            action = decide(self._planner, self.cell, observation)
            step = apply(self.cell, state, action)
            return ("ok", action, step) if int(step.failure[0]) == 0 else ("rejected", None, None)
        empty = state._replace(surface=torch.full_like(state.surface, EMPTY))
        return "stuck" if _any_feasible(self.cell, empty) else "impossible", None, None

    def _add_poses(self, plan: Plan, action: Tensor, step: Step, lengths: Lengths) -> Plan:
        """Return the plan with the poses of a successful action."""
        x_bin, y_bin, x_tote, y_tote, rotation = (int(part) for part in split_action(self.cell, action))
        ee_w, ee_d = self.cell.effector_size
        turned = self.cell.effectors[rotation % 2]
        top = int(step.top[0])
        # The centre comes from the rectangle: the reference cell is half a cell off the centre on even sides.
        left, front = x_bin - reference_cell(ee_w), y_bin - reference_cell(ee_d)
        pick = (
            lengths.horizontal(left + ee_w / 2),
            lengths.horizontal(front + ee_d / 2),
            lengths.vertical(plan.item["h"]),
        )
        x, y = x_tote - turned.ref_x + turned.width / 2, y_tote - turned.ref_y + turned.depth / 2
        place = lengths.horizontal(x), lengths.horizontal(y), lengths.vertical(top)
        return replace(
            plan,
            pick=Pose((x_bin, y_bin), pick),
            place=Pose((x_tote, y_tote), place),
            rotation_degrees=90 * rotation,
            drop_height=lengths.vertical(top - plan.item["h"]),
            action=int(action),
        )

    def _alternatives(self, observation, state: State, chosen: Tensor | None, count: int) -> list[Alternative]:
        """Return the most probable choices, in the order in which the planner prefers them."""
        if count == 0:
            return []
        cell, planner = self.cell, self._planner
        log_probs = planner.policy.action_log_probs(observation)[0]
        if planner.candidates == "all" and planner.policy.ranks_footprints:
            actions, probability = self._probable_footprints(log_probs, state, chosen, count)
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

    def _probable_footprints(
        self, log_probs: Tensor, state: State, chosen: Tensor | None, count: int
    ) -> tuple[Tensor, Tensor]:
        """Return an action for each of the most probable footprints, and the footprint's probability.

        Many actions leave the same footprint, and the policy does not tell them apart. The action returned is the
        chosen one, else the first feasible one, else the first one.
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
        parts = actions.split(4096)  # a few thousand at a time, to save memory
        return torch.cat([apply(self.cell, state.repeat(len(part)), part).failure for part in parts])

    def _reasons(self, state: State) -> dict[str, int]:
        """Return how many of all flat actions fail for each reason."""
        codes = self._simulate(state, torch.arange(self.cell.num_actions, device=state.surface.device))
        counts = codes.bincount(minlength=len(Failure)).tolist()
        return {failure.name.lower(): counts[failure] for failure in Failure if counts[failure]}


def _any_feasible(cell: CellSpec, state: State) -> bool:
    """Return whether any action succeeds."""
    return bool(footprint_mask(cell, placing_maps(cell, state)).any())
