"""The planner for a robot cell: from depth maps or measured boxes to one pick and one place, with reasons if none.

Frames of reference (see ``docs/robot.md``): the bin and the tote have a frame each. The origin is the outer corner of
cell ``(0, 0)`` on the inner floor; x runs along the first axis of the depth map, y along the second, z upwards. Cell
``(i, j)`` covers ``[i, i + 1) x [j, j + 1)`` cells. A rotation turns the end effector, with the item, counter-clockwise
seen from above.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import Tensor

from pickplace.planners.base import MapPlanner, decide
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import Policy
from pickplace.policies.restore import load_critic, load_policy
from pickplace.robot.camera import ToteMap
from pickplace.robot.measure import Box, DepthMapError, checked_number
from pickplace.robot.problem import Pose, Problem, check_tote_height, read_grid, read_metric
from pickplace.robot.training import Training
from pickplace.runs.registry import build, find
from pickplace.task.cell import CellSpec
from pickplace.task.checks import excerpt, is_whole
from pickplace.task.feasibility import action_footprints, action_mask
from pickplace.task.grasps import split_action
from pickplace.task.items import ItemDistribution
from pickplace.task.observation import Term, check_terms, observe
from pickplace.task.state import Failure, Observation

__all__ = ["Alternative", "Box", "DepthMapError", "Plan", "Planner", "Pose"]

MAX_ALTERNATIVES = 100_000  # greatest number of choices that a plan may report


@dataclass(frozen=True)
class Alternative:
    """One of the most probable choices, and whether it succeeds in a forward simulation."""

    action: int  #: flat index
    pick_cell: tuple[int, int]
    place_cell: tuple[int, int]
    rotation_degrees: int  #: turn of the end effector's pose in the tote, in quarter turns
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
    #: "rejected": some action is feasible, but not the one that the planner chooses
    status: str
    item: dict[str, int]  #: the item as the policy sees it: x, y, w, d in cells, h in height units
    box: Box | None  #: the item as it was measured, in metres; None without cell_size
    pick: Pose | None  #: in the bin's frame
    place: Pose | None  #: in the tote's frame; the end effector lets go there
    #: turn between pick and place, counter-clockwise seen from above, -45 to 315; the shorter way round is as good
    rotation_degrees: float | None
    drop_height: float | None  #: height of the item's underside above the tote's floor once it rests
    action: int | None  #: flat index
    occupancy_before: float  #: share of the tote's volume below the surface that the depth map shows, 0 to 1
    occupancy_after: float
    alternatives: list[Alternative]  #: the most probable choices, best first
    reasons: dict[str, int] | None  #: if stuck or impossible: how many of all flat actions fail for each reason
    #: with ``support="bearing"``: 1 where the tote bears weight once the item rests, for the next call; else None
    tote_bearing: list[list[int]] | None
    warnings: list[str]  #: what lies outside the policy's training

    def as_dict(self) -> dict:
        """Return the plan as plain values, ready for JSON."""
        return asdict(self)


class Planner:
    """Plans picks and places for a robot cell.

    Args:
        cell: the cell's sizes and options.
        policy: a policy made for this cell, if the planner needs one.
        candidates: as in :class:`~pickplace.planners.policy.PolicyPlanner`: ``"all"``, or ``K``.
        terms: of the observation, by key; None: the standard ones.
        planner: what decides: None: the policy; the short name of a planner (``"joint_dbl"``), or one that was made.
        items: the item distribution, for a search to imagine.
        training: what the policy was trained with, for :attr:`Plan.warnings`; None: it is not known.
    """

    def __init__(
        self,
        cell: CellSpec,
        policy: Policy | None = None,
        candidates: int | Literal["all"] = "all",
        terms: Mapping[str, Term] | None = None,
        planner: str | MapPlanner | None = None,
        items: ItemDistribution | None = None,
        training: Training | None = None,
        critic=None,
    ):
        self.cell, self.terms, self.policy, self.training = cell, check_terms(terms), policy, training
        if planner is None or planner == "policy":
            if policy is None:
                raise ValueError("policy=None: expected a policy, or planner='joint_dbl' or another that needs none.")
            planner = PolicyPlanner(cell, policy, candidates)
        elif isinstance(planner, str):
            given = {"items": items, "terms": self.terms, "policy": policy, "critic": critic}
            maker = find("planner", planner)
            needs = getattr(maker, "needs", ())
            for key in ("policy", "items"):
                if key in needs and given[key] is None:
                    raise ValueError(
                        f"{key}=None: planner={planner!r} needs it; Planner.load has it from a checkpoint."
                    )
            planner = maker(cell=cell, **{key: given[key] for key in given if key in needs})
        if not isinstance(planner, MapPlanner):
            raise ValueError(
                f"planner={excerpt(planner)}: it does not choose among feasible actions; expected another."
            )
        self._planner: MapPlanner = planner

    @classmethod
    def load(
        cls, path, candidates: int | Literal["all"] = "all", device: str = "cpu", trust: Sequence[str] = (),
        planner: str | None = None, **sizes,
    ) -> "Planner":  # fmt: skip
        """Return a planner from a checkpoint.

        Args:
            path, device, trust, **sizes: see :func:`~pickplace.policies.restore.load_policy`, as for errors.
            candidates: ``"all"``, or ``K``: how many of the most probable actions are tried.
            planner: the short name of what decides, such as ``"lookahead"``; None: the policy.
        """
        trained = load_policy(path, device, trust, **sizes)
        items = build("items", trained.config["items"])
        critic = load_critic(path, trained) if planner == "lookahead" else None
        training = Training.of(trained.config, items)
        return cls(trained.cell, trained.policy, candidates, trained.terms, planner, items, training, critic)

    @torch.inference_mode()
    def plan(
        self,
        bin_depth=None,
        tote_depth=None,
        tote_height=None,
        cell_size: float | None = None,
        accuracy: float = 0.003,
        clearance: float = 0.005,
        alternatives: int = 10,
        tote_bearing=None,
        items: Sequence[Box] | None = None,
        tote: ToteMap | None = None,
    ) -> Plan:
        """Return where to pick the one item in the bin, where to place it and how to turn it.

        Args:
            bin_depth: ``[W_B, D_B]``, or a whole multiple of it: height above the bin's floor, 0 where empty; numpy,
                torch or lists.
            tote_depth: ``[W_T, D_T]``, or a whole multiple of it: remaining height, from the surface up to the rim.
                Of a map with one value a cell each value is the least that was measured in the cell.
            tote_height: height of the tote's rim above its floor; None: that of ``cell.tote_size``.
            cell_size: side of a cell in metres, if the maps and ``tote_height`` are in metres; None: they are whole
                numbers of height units, as in training.
            accuracy: greatest error of a measured height, m.
            clearance: least distance that an item keeps from what stands beside it, on each side; m.
            alternatives: how many of the most probable choices to report, and the chosen one if it is further down;
                0 is fastest. Where no action is feasible, planning takes longest: all are simulated for the reasons.
            tote_bearing: with ``support="bearing"``, ``[W_T, D_T]``, 1 where a cell bears weight, else 0: what the
                plan before this one returned; None: every cell bears weight. In metres, of a map with one value a
                cell, only the floor does then: nothing tells whether a cell is level.
            items: instead of ``bin_depth``: a list of one :class:`Box`, in metres.
            tote: instead of ``tote_depth``: what a :class:`~pickplace.robot.camera.Camera` sees.

        Raises:
            DepthMapError: for a map of another shape or type, a value that is not finite or out of range, an empty
                bin, or anything but one cuboid in it; it names the cell.
        """
        self.check_settings(tote_height, cell_size, accuracy, clearance, alternatives)
        device = torch.device("cpu") if self.policy is None else next(self.policy.parameters()).device
        if (tote_depth is None) == (tote is None):
            got = "neither" if tote is None else "both"
            raise DepthMapError(f"tote_depth, tote: got {got}, expected one of the two.")
        if cell_size is None:
            for key, given in (("items", items), ("tote", tote)):
                if given is not None:
                    raise DepthMapError(
                        f"cell_size=None: expected the side of a cell in metres, as {key} are measured."
                    )
            if bin_depth is None:
                raise DepthMapError("bin_depth: missing; expected a depth map.")
            problem = read_grid(self.cell, bin_depth, tote_depth, tote_height, tote_bearing, device)
        else:
            problem = read_metric(
                self.cell, cell_size, accuracy, clearance, bin_depth, items, tote if tote_depth is None else tote_depth,
                tote_height, tote_bearing, device,
            )  # fmt: skip
        observation = observe(self.terms, self.cell, problem.seen)
        status, action = self._decide(problem, observation)
        pick, place, turn, top = (None,) * 4 if action is None else problem.poses(action)
        before, bearing = problem.filled(), problem.bearing_after(action)
        return Plan(
            status=status,
            item={key: int(value) for key, value in problem.seen.item._asdict().items()},
            box=problem.box,
            pick=pick,
            place=place,
            rotation_degrees=turn,
            drop_height=None if top is None else problem.drop_height(top),
            action=None if action is None else int(action),
            occupancy_before=before,
            occupancy_after=before if action is None else before + problem.item_share(),
            alternatives=self._alternatives(problem, observation, action, alternatives),
            reasons=self._reasons(problem) if status in ("stuck", "impossible") else None,
            tote_bearing=bearing.int().tolist() if self.cell.support == "bearing" else None,
            warnings=[] if self.training is None else self.training.warnings(self.cell, problem.seen.item),
        )

    def check_settings(self, tote_height, cell_size, accuracy, clearance, alternatives) -> None:
        """Check the arguments of :meth:`plan` beside the maps.

        Raises:
            DepthMapError: naming the argument that is out of range.
        """
        if cell_size is not None:
            checked_number("cell_size", cell_size, "a length in metres, 0.001 to 10", lambda v: 1e-3 <= v <= 10)
        checked_number("accuracy", accuracy, "metres, 0 to 0.1", lambda v: 0 <= v <= 0.1)
        checked_number("clearance", clearance, "metres, 0 to 0.1", lambda v: 0 <= v <= 0.1)
        if tote_height is not None:
            check_tote_height(self.cell, tote_height, cell_size)
        if not is_whole(alternatives) or not 0 <= alternatives <= MAX_ALTERNATIVES:
            expected = f"expected a whole number >= 0 and <= {MAX_ALTERNATIVES:,}."
            raise DepthMapError(f"alternatives={excerpt(alternatives)}: {expected}")

    def _decide(self, problem: Problem, observation: Observation) -> tuple[str, Tensor | None]:
        """Return the status, and the action if one was found that succeeds."""
        if not problem.is_feasible():
            return "stuck" if problem.is_feasible_in_an_empty_tote() else "impossible", None

        def choose(observation):
            return self._planner.choose(problem.cell, problem.state, problem.maps, observation)

        action = decide(self._planner, problem.cell, observation, choose)
        return ("ok", action) if int(problem.failures(action)) == 0 else ("rejected", None)

    def _alternatives(
        self, problem: Problem, observation: Observation, chosen: Tensor | None, count: int
    ) -> list[Alternative]:
        """Return the most probable choices, in the order in which the planner prefers them."""
        if count == 0 or not isinstance(self._planner, PolicyPlanner):
            return []
        cell, policy, candidates = problem.cell, self._planner.policy, self._planner.candidates
        log_probs = policy.with_cell(cell).action_log_probs(observation)[0]
        if candidates == "all" and policy.ranks_footprints:
            actions, probability = self._probable_footprints(log_probs, problem, chosen, count)
        else:
            tried = cell.num_actions if candidates == "all" else min(candidates, cell.num_actions)
            actions = log_probs.topk(tried).indices[:count]  # the same call as the planner's, so that ties agree
            if chosen is not None and not (actions == chosen).any():
                actions = torch.cat([actions, chosen])
            probability = log_probs[actions].exp()
        failure = problem.failures(actions)
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

    @staticmethod
    def _probable_footprints(
        log_probs: Tensor, problem: Problem, chosen: Tensor | None, count: int
    ) -> tuple[Tensor, Tensor]:
        """Return an action for each of the most probable footprints, and the footprint's probability.

        Many actions leave the same footprint, and the policy does not tell them apart. The action returned is the
        chosen one, else the first feasible one, else the first one.
        """
        cell = problem.cell
        footprint = action_footprints(cell, problem.state.item)[0]  # [N_a]
        lands = footprint >= 0
        total = log_probs.new_zeros(cell.num_footprints)
        total.scatter_add_(0, footprint[lands], log_probs[lands].exp())
        reachable = torch.zeros_like(total, dtype=torch.bool).index_fill_(0, footprint[lands], True)
        ranked = torch.where(reachable, total, -1).argsort(descending=True, stable=True)[: int(reachable.sum())][:count]
        if chosen is not None and not (ranked == footprint[chosen]).any():
            ranked = torch.cat([ranked, footprint[chosen]])
        preference = action_mask(cell, problem.maps)[0].int()
        if chosen is not None:
            preference[chosen] = 2
        shown = [torch.where(footprint == wanted, preference, -1).argmax() for wanted in ranked]
        return torch.stack(shown) if shown else ranked, total[ranked]

    @staticmethod
    def _reasons(problem: Problem) -> dict[str, int]:
        """Return how many of all flat actions fail for each reason."""
        codes = problem.failures(torch.arange(problem.cell.num_actions, device=problem.state.surface.device))
        counts = codes.bincount(minlength=len(Failure)).tolist()
        return {failure.name.lower(): counts[failure] for failure in Failure if counts[failure]}
