"""The planner for a robot cell: from depth maps or measured boxes to one pick and one place, or the reasons for none.

Frames of reference (see ``docs/robot.md``): the bin and the tote have a frame each. The origin is the outer corner of
cell ``(0, 0)`` on the inner floor; x runs along the first axis of the depth map, y along the second, z upwards. Cell
``(i, j)`` covers ``[i, i + 1) x [j, j + 1)`` cells. A rotation turns the end effector, with the item, counter-clockwise
seen from above.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from pickplace.common.validate import excerpt, expect, refuse_if, whole_number
from pickplace.config.registry import build, find
from pickplace.items.distributions import ItemDistribution
from pickplace.planners.base import MapPlanner
from pickplace.planners.policy import PolicyPlanner
from pickplace.planners.use import decide
from pickplace.policies.base import MASKED, Policy, Ranking, ScoresActions, ScoresFootprints
from pickplace.policies.restore import load_critic, load_policy
from pickplace.robot.box import Box, DepthMapError
from pickplace.robot.measured_problem import read_metric
from pickplace.robot.problem import Pose, Problem, check_robot_cell, read_grid
from pickplace.robot.scene import Scene
from pickplace.robot.training_envelope import TrainingEnvelope
from pickplace.rules.cell import CellSpec
from pickplace.rules.checks import PICK_FAILURES
from pickplace.rules.grasps import join_pick, split_action
from pickplace.rules.item import Observation
from pickplace.rules.masks import footprint_mask
from pickplace.rules.observation import HANDLING_TERMS, Term, ToteCapacity, check_terms, observe
from pickplace.rules.state import Failure

ACTIONS_AT_ONCE = 2**16  # greatest number of actions whose reasons are looked up at once
MAX_ALTERNATIVES = 100_000  # greatest number of choices that a plan may report
CHOOSERS = "expected one item, or a checkpoint of model=afterstate, or of model=fcn_grasp that was trained with a mask"


@dataclass(frozen=True)
class Alternative:
    """One of the most probable choices; with ``candidates=K``, one of the actions that were tried."""

    action: int  #: flat index
    pick_cell: tuple[int, int]  #: of the end effector's reference cell
    place_cell: tuple[int, int]  #: the same, in the tote
    rotation_degrees: int  #: turn of the end effector's pose in the tote, in quarter turns
    #: of the item with its footprint, or of the action, among the feasible ones; with ``candidates=K`` among all
    probability: float
    rejected: str | None  #: the reason why it would fail; None if it would succeed
    chosen: bool  #: whether it is the plan
    item_number: int = 0  #: of the item that it takes, see :attr:`Plan.item_number`; 0 if it grips none


@dataclass(frozen=True)
class Plan:
    """One pick and one place for an item in the bin; made by :meth:`Planner.plan`.

    The lengths ``center`` and ``drop_height`` are in metres if ``cell_size`` was given, else in cells along x and y and
    in height units along z.
    """

    #: "ok"; "stuck": no action is feasible; "impossible": no action would be feasible in an empty tote either;
    #: "rejected": some action is feasible, but not the one that the planner chooses
    status: str
    #: the item of :attr:`item_number`, as the policy sees it: x, y, w, d in cells, h in height units; None if several
    #: items lie in the bin and none is chosen
    item: dict[str, int] | None
    #: the same item as measured, in metres, with its yaw brought above -45 and to at most 45 degrees, which may
    #: exchange ``w`` and ``d``; None without cell_size
    box: Box | None
    pick: Pose | None  #: in the bin's frame
    place: Pose | None  #: in the tote's frame; the end effector lets go there
    #: turn between pick and place, counter-clockwise seen from above, -45 to 315; the shorter way round is as good
    rotation_degrees: float | None
    drop_height: float | None  #: height of the item's underside above the tote's floor once it rests
    action: int | None  #: flat index
    occupancy_before: float  #: share of the tote's volume below the surface that the depth map shows, 0 to 1
    occupancy_after: float  #: the same with the item
    alternatives: list[Alternative]  #: the most probable choices, best first; none if nothing is feasible
    reasons: dict[str, int] | None  #: without a plan: how many actions fail for each reason; if rejected, the chosen's
    #: with ``support="bearing"``: 1 where the tote bears weight once the item rests, for the next call; else None
    tote_bearing: list[list[int]] | None
    warnings: list[str]  #: a sentence for each thing that lies outside the policy's training
    #: of the item that is taken, or that was chosen if rejected, from 0: in ``items``, or among the ascending labels
    item_number: int | None = None
    #: if stuck or impossible: a sentence for each item that the gripper cannot grip, wherever it lies; such as
    #: "items[1]: the cup does not fit on this item, with cells of 50 mm; no pick takes it."
    hints: list[str] = field(default_factory=list)
    #: the item at rest in the tote, in the tote's frame; ``h`` is the height of its top. For ``placed`` of the next
    #: scene; None without an action, or without ``cell_size``
    placed: Box | None = None

    def as_dict(self) -> dict:
        """Return the plan as plain values, ready for JSON."""
        return asdict(self)


class Planner:
    """Plans picks and places for a robot cell.

    Args:
        cell: the cell's sizes and options.
        policy, critic: a policy made for this cell and its critic, if the planner needs them.
        candidates: as in :class:`~pickplace.planners.policy.PolicyPlanner`: ``"all"``, or ``K``.
        terms: of the observation, by key; None: the standard ones.
        planner: makes the decisions: the short name of a planner (``"joint_dbl"``), a config of the group ``planner``
            (``{"_target_": "beam", "depth": 3}``), or a planner object; None: the policy.
        items: the item distribution, from which a search draws items that it imagines.
        training: items and sizes of the policy's training, for :attr:`Plan.warnings`; None: not known.

    The bin may hold any number of items, and any number may be seen to come, whatever ``cell.bin_items`` and
    ``cell.preview`` are. Only a planner object must have been made for several items.
    """

    def __init__(
        self,
        cell: CellSpec,
        policy: Policy | None = None,
        candidates: int | Literal["all"] = "all",
        terms: Mapping[str, Term] | None = None,
        planner: str | Mapping[str, Any] | MapPlanner | None = None,
        items: ItemDistribution | None = None,
        training: TrainingEnvelope | None = None,
        critic=None,
    ):
        check_robot_cell(cell)
        self._handling = cell.handling
        cell = replace(cell, handling=False, preview=0)  # each scene has its own loads and preview
        loads = [key for key, term in (terms or {}).items() if key in HANDLING_TERMS or isinstance(term, ToteCapacity)]
        read = [key for key in loads if policy is not None and key in policy.in_keys]
        refuse_if(read, f"policy: it reads {', '.join(read)}, which a scene does not have; expected another.")
        terms = {key: term for key, term in (terms or {}).items() if key not in (*loads, "coming")}
        self.cell, self.policy, self.training = cell, policy, training
        self.terms = check_terms(terms, cell)
        self._settings, self._parts = None, {"items": items, "critic": critic}
        if planner is None or isinstance(planner, (str, Mapping)):
            self._settings = planner_settings(planner, candidates)
            planner = self._make(cell, policy, self.terms)
        refuse_if(
            not isinstance(planner, MapPlanner),
            f"planner={excerpt(planner)}: it does not choose among feasible actions; expected another.",
        )
        self._planners: dict[tuple[int, int], MapPlanner] = {(cell.bin_items, 0): planner}  # items in the bin, to come

    @classmethod
    def load(
        cls, path, candidates: int | Literal["all"] = "all", device: str = "cpu", trust: Sequence[str] = (),
        planner: str | Mapping[str, Any] | None = None, **sizes,
    ) -> "Planner":  # fmt: skip
        """Return a planner from a checkpoint.

        Args:
            path, device, trust, **sizes: see :func:`~pickplace.policies.restore.load_policy`, as for errors.
            candidates: ``"all"``, or ``K``: number of most probable actions that are tried.
            planner: the short name of a planner, such as ``"beam"``, or its config; None: the policy.
        """
        trained = load_policy(path, device, trust, **sizes)
        items = build("items", trained.config["items"])
        needs = getattr(find("planner", planner_settings(planner)["_target_"]), "needs", ())
        return cls(
            trained.cell, trained.policy, candidates, trained.terms, planner, items,
            TrainingEnvelope.of(trained.config, items), load_critic(path, trained) if "critic" in needs else None,
        )  # fmt: skip

    @torch.inference_mode()
    def plan(self, scene: Scene, *, alternatives: int = 10, exclude: Sequence[Sequence[float]] = ()) -> Plan:
        """Choose an item in the bin, its pick, its place and its turn.

        Args:
            scene: measured contents of bin and tote.
            alternatives: number of most probable choices to report, and the chosen one if it is further down; 0 is
                fastest.
            exclude: points ``(x, y, ...)`` in the bin's frame, such as ``pick.center`` of plans whose grasp failed: no
                pick within half a cell of one is planned. Metres with ``cell_size``, else cells.

        Raises:
            EmptyBinError: for a map of an empty bin.
            DepthMapError: for a map of another shape or type, a value that is not finite or out of range, or anything
                but one cuboid in the bin or under each label; it names the cell. Also for several items if the planner
                cannot choose among them.
            ValueError: for another argument that cannot be used.
        """
        refuse_if(
            not isinstance(scene, Scene),
            f"scene: got {type(scene).__name__}, expected a Scene, such as Scene.from_maps(bin_depth, tote_depth).",
        )
        whole_number("alternatives", alternatives, 0, MAX_ALTERNATIVES)
        device = torch.device("cpu") if self.policy is None else next(self.policy.parameters()).device
        is_metric = scene.cell_size is not None
        refuse_if(
            self._handling and not is_metric,
            "env.handling=true: a scene in whole cells has no loads; expected one in metres, with Box(..., mass=, "
            "max_load=), and placed.",
            DepthMapError,
        )
        problem = (read_metric if is_metric else read_grid)(self.cell, scene, device, exclude)
        planner, terms = self._planner_of(problem.maps.bin_items, len(scene.coming or ()), is_metric)
        observation = observe(terms, problem.cell, problem.seen)
        planner.restart()
        status, action, ranking = _decide(planner, problem, observation)
        number = None if action is None else int(problem.taken_items(action))
        reasons = None
        if status != "ok":
            self._refuse_unknown(scene, device, exclude)  # first: all reasons take a while
            reasons, action = _reasons(problem, action), None
        known = 0 if problem.maps.bin_items == 1 else number
        motion = None if action is None else problem.motion(action)
        pick, place, turn, drop_height = motion or (None,) * 4
        seen = None if known is None else problem.seen.items.cuboids[0, known].tolist()
        box = None if known is None or not problem.boxes else problem.boxes[known]
        placed = None if box is None or motion is None else _at_rest(box, *motion)
        (before, gained), bearing = problem.shares(number or 0), problem.bearing_after(action)
        return Plan(
            status=status,
            item=None if seen is None else dict(zip("xywdh", seen, strict=True)),
            box=box,
            pick=pick,
            place=place,
            rotation_degrees=turn,
            drop_height=drop_height,
            action=None if action is None else int(action),
            occupancy_before=before,
            occupancy_after=before if action is None else before + gained,
            alternatives=_list_alternatives(planner, problem, ranking, action, alternatives),
            reasons=reasons,
            tote_bearing=bearing.int().tolist() if self.cell.support.marks_bearing else None,
            warnings=[] if self.training is None else self.training.warnings(self.cell, problem.seen),
            item_number=None if number is None else problem.numbers[number],
            hints=problem.hints() if status in ("stuck", "impossible") else [],
            placed=placed,
        )

    def _refuse_unknown(self, scene: Scene, device, exclude) -> None:
        """Refuse a scene that has no plan, if images with fewer unknown places might allow one."""
        may_have_plan = scene.has_holes
        if not may_have_plan and (likely := scene.without_gaps()) is not None:
            problem = read_metric(self.cell, likely, device, exclude)
            may_have_plan = bool(footprint_mask(problem.cell, problem.maps).any())
        refuse_if(
            may_have_plan,
            "depth: no plan avoids what the images leave unknown in bin and tote; expected more pixels with a depth: "
            "take another image.",
            DepthMapError,
        )

    def _planner_of(self, count: int, preview: int, is_metric: bool) -> tuple[MapPlanner, Mapping[str, Term]]:
        """Return the planner for these numbers of items in the bin and to come, and the terms of the observation.

        Raises:
            DepthMapError: for a planner that cannot choose among several items.
        """
        terms = check_terms(self.terms, replace(self.cell, bin_items=max(count, self.cell.bin_items), preview=preview))
        if self._settings is not None and (count, preview) not in self._planners:
            cell, policy = replace(self.cell, bin_items=count, preview=preview), self.policy
            try:
                policy = policy and policy.with_cell(cell)
            except ValueError as error:
                raise _several_items(policy, count) from error
            self._planners[count, preview] = self._make(cell, policy, terms)
        planner = self._planners.get((count, preview), self._planners[self.cell.bin_items, 0])
        if count > 1:
            _check_choice(planner, count, is_metric)
        return planner, terms

    def _make(self, cell: CellSpec, policy: Policy | None, terms: Mapping[str, Term]) -> MapPlanner:
        """Make the planner of the settings for a cell, a policy of this cell and the terms of the observation."""
        assert self._settings is not None
        maker = find("planner", name := self._settings["_target_"])
        parts, needs = {**self._parts, "policy": policy, "terms": terms}, getattr(maker, "needs", ())
        for key in ("policy", "items"):
            refuse_if(
                key in needs and parts[key] is None,
                f"{key}=None: planner={name!r} needs it; Planner.load has it from a checkpoint.",
            )
        if "critic" in needs and parts["critic"] is not None:
            parts["critic"] = parts["critic"].with_bin_items(cell.bin_items)
        return build("planner", self._settings, cell=cell, **{key: parts[key] for key in needs})


def _at_rest(box: Box, pick: Pose, place: Pose, turn: float, drop_height: float) -> Box:
    """Return an item at rest in the tote; the turn is in degrees."""
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    x, y = box.x - pick.center[0], box.y - pick.center[1]
    centre = {"x": place.center[0] + x * cos - y * sin, "y": place.center[1] + x * sin + y * cos}
    return replace(box, **centre, h=drop_height + box.h, yaw=box.yaw + turn).upright()


def planner_settings(
    planner: str | Mapping[str, Any] | None, candidates: int | Literal["all"] = "all"
) -> dict[str, Any]:
    """Return the config of a planner, given its short name or its config; the policy's includes ``candidates``."""
    settings = dict(planner) if isinstance(planner, Mapping) else {"_target_": planner or "policy"}
    expect(isinstance(settings.get("_target_"), str), "planner", planner, "a config with the key _target_")
    if settings["_target_"] != "policy" or candidates == "all":
        return settings
    expect("candidates" not in settings, "candidates", candidates, "'all' with a planner that has its own")
    return {**settings, "candidates": candidates}


def _check_choice(planner: MapPlanner, count: int, is_metric: bool) -> None:
    """Refuse several items in the bin for a planner that cannot choose among them."""
    policy = getattr(planner, "policy", None)
    refuse_if(
        planner.cell.bin_items == 1,
        f"bin: got {count} items, expected one: the planner was made for a cell with bin_items=1; expected one "
        f"made with bin_items={count}, or its name.",
        DepthMapError,
    )
    if policy is not None and not isinstance(policy, (ScoresFootprints, ScoresActions)):
        raise _several_items(policy, count)
    refuse_if(
        is_metric and policy is not None and not isinstance(policy, ScoresFootprints),
        f"bin: got {count} items in metres, each on a grid of its own, while {type(policy).__name__} sees the bin "
        f"as one grid; {CHOOSERS}.",
        DepthMapError,
    )


def _several_items(policy, count: int) -> DepthMapError:
    """Return the error of a policy that does not choose among several items in the bin."""
    return DepthMapError(f"bin: got {count} items, among which {type(policy).__name__} does not choose; {CHOOSERS}.")


def _decide(
    planner: MapPlanner, problem: Problem, observation: Observation
) -> tuple[str, Tensor | None, Ranking | None]:
    """Return the status, the action if one is feasible, and the policy's ranking if a policy was asked; else None."""
    if not footprint_mask(problem.cell, problem.maps).any():
        return "stuck" if problem.is_feasible_in_empty_tote() else "impossible", None, None
    cell, ranking = problem.cell, None

    def choose(seen: Observation) -> Tensor:
        nonlocal ranking
        if not isinstance(planner, PolicyPlanner):
            return planner.choose(cell, problem.state, problem.maps, seen)
        ranking = planner.rank(cell, problem.state, problem.maps, seen)
        return ranking.action

    action = decide(planner, cell, observation, choose)
    return "ok" if int(problem.failures(action)) == 0 else "rejected", action, ranking


def _reasons(problem: Problem, chosen: Tensor | None) -> dict[str, int]:
    """Count the flat actions that fail for each reason, each with the item that its pick takes; or only the chosen."""
    if chosen is not None:
        return {Failure(int(problem.failures(chosen))).name.lower(): 1}
    cell, device = problem.cell, problem.state.surface.device
    picks = torch.arange(cell.num_picks, device=device)
    codes = problem.failures(join_pick(cell, picks, 0))
    by_pick = torch.isin(codes, torch.tensor(PICK_FAILURES, device=device))
    of_pick = cell.num_places * cell.rotations  # actions
    counts = codes[by_pick].bincount(minlength=len(Failure)) * of_pick
    others = picks[~by_pick]
    for some in others.split(max(1, ACTIONS_AT_ONCE // of_pick)) if len(others) else ():
        actions = join_pick(cell, some[:, None], torch.arange(of_pick, device=device)).flatten()
        counts += problem.failures(actions).bincount(minlength=len(Failure))
    return {failure.name.lower(): count for failure, count in zip(Failure, counts.tolist(), strict=True) if count}


def _list_alternatives(
    planner: MapPlanner, problem: Problem, ranking: Ranking | None, chosen: Tensor | None, count: int
) -> list[Alternative]:
    """Return the most probable choices, in the order in which the planner prefers them, and the chosen one."""
    if count == 0 or ranking is None or not isinstance(planner, PolicyPlanner):
        return []
    log_probs = ranking.scores.log_softmax(1)
    _, tried = planner.tried(ranking.scores)
    choices = tried[0, :count]
    choices = choices[ranking.scores[0, choices] > MASKED]
    actions = ranking.reach(torch.zeros_like(choices), choices)
    if chosen is not None and not (actions == chosen).any():  # it is tried after others, so choices are flat actions
        choices, actions = torch.cat([choices, chosen]), torch.cat([actions, chosen])
    probability, failures = log_probs[0, choices].exp(), problem.failures(actions)
    if planner.candidates == "all":
        considered = failures == 0
        actions, probability, failures = actions[considered], probability[considered], failures[considered]
    if not len(actions):
        return []
    places, numbers = split_action(problem.cell, actions), problem.taken_items(actions)
    columns = actions, *places, probability, failures, numbers
    return [
        Alternative(
            action=action,
            pick_cell=(x_bin, y_bin),
            place_cell=(x_tote, y_tote),
            rotation_degrees=90 * rotation,
            probability=share,
            rejected=Failure(code).name.lower() if code else None,
            chosen=chosen is not None and action == int(chosen),
            item_number=problem.numbers[number],
        )
        for action, x_bin, y_bin, x_tote, y_tote, rotation, share, code, number in zip(
            *(column.tolist() for column in columns), strict=True
        )
    ]
