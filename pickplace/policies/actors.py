"""Policies over joint (pick, place, rotation) actions, and how TorchRL sees them.

A policy chooses among *choices*: flat actions, or classes of flat actions that it has no reason to tell apart. The
probability of a choice is spread evenly over the flat actions of its class, so PPO's ratio and entropy are those of the
choice. Every policy offers

* ``choice_key``: the name of its choice in the TensorDict, and ``in_keys``: what ``forward`` reads;
* ``masks``: the masks that the environment must emit for training it;
* ``forward(...) -> logits [N, choices]``, float32;
* ``to_action(choice, bin_depth, tote_depth, tote_height) -> int64 [N]``: a flat action of the class, drawn evenly
  (the lowest one when exploration is off);
* ``to_choice(action, bin_depth, tote_depth, tote_height) -> int64 [N]``: the class of a flat action that succeeds;
* ``action_log_probs(bin_depth, tote_depth) -> [N, N_a]``: the distribution over flat actions, without any mask;
* ``excludes``: what this distribution gives probability 0 all the same, by construction; None if nothing.
"""

from abc import ABC, abstractmethod

import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, exploration_type

from pickplace.policies.networks.conv4d import Conv4dPolicy
from pickplace.policies.networks.footprint_fcn import FootprintFcn
from pickplace.task.geometry import Rules

#: The logit of what must not be chosen, far below what a network may score: its probability is exactly 0 in float32.
#: What float32 has left below it is for differences from the greatest logit.
MASKED = -1e38


class Choice(Categorical):
    """A categorical distribution over choices, without the checks that dominate a small PPO update."""

    def __init__(self, logits: Tensor):
        super().__init__(logits=logits, validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """The most probable choice."""
        return self.logits.argmax(-1)

    def sample(self, sample_shape=()):
        """Inverse-CDF sampling with one uniform number a row."""
        if sample_shape:
            return super().sample(sample_shape)
        edges = self.probs.double().cumsum(-1)
        uniform = torch.rand(edges.shape[:-1], dtype=torch.float64, device=edges.device) * edges[..., -1]
        return torch.searchsorted(edges, uniform[..., None], right=True)[..., 0].clamp(max=edges.shape[-1] - 1)


class FlatPolicy(nn.Module):
    """Chooses among all ``N_a`` flat actions; the paper's ``fcn4d``.

    Args:
        rules: the task's sizes.
        mask_infeasible: choose among feasible actions only (the paper does not).
        network: arguments of :class:`~pickplace.policies.networks.conv4d.Conv4dPolicy`.
    """

    choice_key = "action"
    excludes: str | None = None

    def __init__(self, rules: Rules, mask_infeasible: bool = False, **network):
        super().__init__()
        self.rules, self.mask_infeasible = rules, mask_infeasible
        self.masks = ("action",) if mask_infeasible else ()
        self.in_keys = ["bin_depth", "tote_depth"] + ["action_mask"] * mask_infeasible
        self.network = Conv4dPolicy(4, **network)  # of which the first R count: the weights serve fewer rotations too

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Logits ``[N, N_a]``; with a mask only those of the actions that it allows."""
        rotations = self.rules.rotations
        if action_mask is None:
            return self.network(bin_depth, tote_depth).unflatten(1, (-1, 4))[..., :rotations].flatten(1)
        # Pick cells from which nothing can be picked need no logits: most of them, and most of the arithmetic.
        by_pick = action_mask.unflatten(1, (self.rules.num_picks, -1))
        row, pick = by_pick.any(2).nonzero(as_tuple=True)
        needed = self.network(bin_depth[row], tote_depth[row], pick).unflatten(1, (-1, 4))[..., :rotations].flatten(1)
        logits = needed.new_full(by_pick.shape, MASKED).index_put((row, pick), needed)
        return torch.where(action_mask, logits.flatten(1), MASKED)

    def to_action(self, choice: Tensor, *_) -> Tensor:
        return choice

    def to_choice(self, action: Tensor, *_) -> Tensor:
        return action

    def action_log_probs(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        return self(bin_depth, tote_depth).log_softmax(-1)


def spread_over_actions(log_probs: Tensor, rules: Rules, pick: Tensor) -> Tensor:
    """``[N, W_T * D_T * R]`` with the pick cells ``[N]`` as ``[N, N_a]``: minus infinity for every other pick."""
    number = torch.arange(log_probs.shape[1], device=pick.device)
    out = log_probs.new_full((len(log_probs), rules.num_actions), -torch.inf)
    return out.scatter_(1, pick[:, None] * len(number) + number, log_probs)


def count_ways(outcome: Tensor, allowed: Tensor, rules: Rules) -> Tensor:
    """How many of the allowed actions, bool ``[N, M]``, have each outcome; of int64 ``[N, M]``, ``[N, Q*W_T*D_T]``."""
    ways = outcome.new_zeros(len(outcome), rules.num_outcomes + 1)
    return ways.scatter_add_(1, outcome + 1, allowed.long())[:, 1:]


class AtHeuristicPick(ABC):
    """Individual planning: the pick is heuristic, and the policy that this is mixed into scores place and rotation.

    With a mask, a state in which nothing can be placed with the heuristic pick is left unmasked: the policy fails then,
    as it must.
    """

    choice_key = "placement"
    excludes: str | None = "every pick but the heuristic one"
    rules: Rules

    @abstractmethod
    def _scores(self, bin_depth: Tensor, tote_depth: Tensor, pick: Tensor) -> Tensor:
        """A logit for each place and rotation with the pick cells ``[N]``: ``[N, W_T * D_T * R]``."""

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Logits ``[N, W_T * D_T * R]``."""
        pick = self.rules.heuristic_pick(self.rules.read_item(bin_depth))
        logits = self._scores(bin_depth, tote_depth, pick)
        if action_mask is None:
            return logits
        allowed = self.rules.at_pick(action_mask, pick)
        return torch.where(allowed | ~allowed.any(1, keepdim=True), logits, MASKED)

    def to_action(self, choice: Tensor, bin_depth: Tensor, *_) -> Tensor:
        rules = self.rules
        pick = rules.heuristic_pick(rules.read_item(bin_depth))
        return pick * rules.num_places * rules.rotations + choice

    def to_choice(self, action: Tensor, *_) -> Tensor:
        """Place and rotation, whatever the pick."""
        return action % (self.rules.num_places * self.rules.rotations)

    def action_log_probs(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Minus infinity for every pick but the heuristic one."""
        pick = self.rules.heuristic_pick(self.rules.read_item(bin_depth))
        return spread_over_actions(self.forward(bin_depth, tote_depth).log_softmax(-1), self.rules, pick)


class IndividualPolicy(AtHeuristicPick, FlatPolicy):
    """``individual_rl``, what the paper compares with: the pick is heuristic, only place and rotation are learnt.

    The network is that of ``fcn4d``; its features after the last ``3x3x3x3`` convolution are selected at the pick cell,
    so that nothing else of them is computed.

    Args: as :class:`FlatPolicy`.
    """

    def _scores(self, bin_depth: Tensor, tote_depth: Tensor, pick: Tensor) -> Tensor:
        logits = self.network(bin_depth, tote_depth, pick).unflatten(1, (-1, 4))
        return logits[..., : self.rules.rotations].flatten(1)


class TypicalPolicy(FlatPolicy):
    """The "typical" network that the paper compares with: ``fcn4d``, then one fully connected layer over all logits.

    The layer is a square of side ``N_a``, so that it is tied to the sizes that it is trained at, and its memory grows
    with the fourth power of the tote's side: 50 MB at ``6x6``, 400 MB at ``10x10``, 32 GB at ``30x30`` with ``R=4``.

    Args: as :class:`FlatPolicy`.

    Raises:
        ValueError: for a layer that memory does not hold.
    """

    def __init__(self, rules: Rules, mask_infeasible: bool = False, **network):
        super().__init__(rules, mask_infeasible, **network)
        try:
            self.join = nn.Linear(rules.num_actions, rules.num_actions)
        except RuntimeError as error:  # torch's way to say that there is no memory
            size = 4 * rules.num_actions**2 / 1e9
            raise ValueError(
                f"model=typical: its last layer has {rules.num_actions:,}^2 weights, {size:.1f} GB, for which there "
                "is no memory; expected a smaller env.tote_size or env.bin_size."
            ) from error

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Logits ``[N, N_a]``."""
        logits = self.join(super().forward(bin_depth, tote_depth))
        return logits if action_mask is None else torch.where(action_mask, logits, MASKED)


class OutcomePolicy(nn.Module):
    """``fcn_grasp`` with masking: chooses among the distinct footprints that some action reaches.

    What the tote looks like after a success depends on the footprint alone; the grasp only decides whether it can be
    reached, and the mask knows that.

    Args:
        rules: the task's sizes.
        network: arguments of :class:`~pickplace.policies.networks.footprint_fcn.FootprintFcn`.
    """

    choice_key = "outcome"
    excludes: str | None = "failed picks and footprints outside the tote"
    masks: tuple[str, ...] = ("outcome",)
    mask_infeasible = True
    in_keys = ["bin_depth", "tote_depth", "outcome_mask"]

    def __init__(self, rules: Rules, **network):
        super().__init__()
        self.rules = rules
        self.network = FootprintFcn(**network)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, outcome_mask: Tensor) -> Tensor:
        """Logits ``[N, Q * W_T * D_T]``; footprints that the mask rules out are not computed."""
        row, outcome = outcome_mask.nonzero(as_tuple=True)
        scores = self.network.at(bin_depth, tote_depth, row, outcome)
        return scores.new_full(outcome_mask.shape, MASKED).index_put((row, outcome), scores[:, 0])

    def to_action(self, choice: Tensor, bin_depth: Tensor, tote_depth: Tensor, tote_height: Tensor) -> Tensor:
        placements = self.rules.placements_from_depth(bin_depth, tote_depth, tote_height)
        return pick_one(self.rules.actions_reaching(placements, choice))

    def to_choice(self, action: Tensor, bin_depth: Tensor, tote_depth: Tensor, tote_height: Tensor) -> Tensor:
        (tote_w, tote_d, _), item = self.rules.tote_size, self.rules.read_item(bin_depth)
        heights = (tote_height[:, None, None] - tote_depth).int()
        x, y, w, _ = self.rules.apply(heights, tote_height, item, action).footprint.unbind(-1)
        turned = (w != item.w).long()  # a square item is the same either way
        return (turned * tote_w + x) * tote_d + y

    def action_log_probs(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Without a mask: an action whose pick misses, or that leaves the tote, has no outcome, so probability 0."""
        item = self.rules.read_item(bin_depth)
        outcome = self.rules.action_outcomes(item)  # [N, N_a], -1 where nothing reaches the tote
        ways = count_ways(outcome, outcome >= 0, self.rules)
        logits = self.network(bin_depth, tote_depth, self.rules.parities).flatten(1)
        logits = torch.where(ways > 0, logits, MASKED)
        share = logits.log_softmax(-1) - ways.clamp(min=1).log()
        return torch.where(outcome >= 0, share.gather(1, outcome.clamp(min=0)), MASKED)


class GraspPolicy(nn.Module):
    """``fcn_grasp`` without masking: chooses among (grasp class, place cell), feasible or not, or to miss the item.

    The grasp class is how the item lies under the rotated end effector. All picks that lift nothing are one more
    choice, which the policy must learn to avoid, as it must learn walls, collisions and support.

    Args:
        rules: the task's sizes.
        network: arguments of :class:`~pickplace.policies.networks.footprint_fcn.FootprintFcn`, which scores each footprint once for
            every offset of the item under the end effector.
    """

    choice_key = "grasp"
    excludes: str | None = None
    masks: tuple[str, ...] = ()
    mask_infeasible = False
    in_keys = ["bin_depth", "tote_depth"]
    scored: Tensor  # see `_scored`

    def __init__(self, rules: Rules, **network):
        super().__init__()
        self.rules = rules
        self.classes = rules.parities * rules.num_offsets**2
        self.network = FootprintFcn(rules.num_offsets**2, **network)
        self.miss, self.outside = (nn.Parameter(torch.zeros(())) for _ in range(2))
        self.register_buffer("scored", self._scored(), persistent=False)

    def _maps(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Logits of every (grasp class, place cell), ``[N, Q*O*O, W_T*D_T]``."""
        scores = self.network(bin_depth, tote_depth, self.rules.parities).flatten(1)
        return torch.cat([scores, self.outside.expand(len(scores), 1)], 1)[:, self.scored]

    def _choices(self, bin_depth: Tensor, tote_depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logit per flat action of each choice, the choice's number of flat actions, and each pick's grasp class."""
        maps = self._maps(bin_depth, tote_depth)
        logits = torch.cat([maps.flatten(1), self.miss.expand(len(maps), 1)], 1)
        picks = self._pick_classes(bin_depth)
        missing = (picks < 0).sum((1, 2)) * self.rules.num_places
        counts = maps.new_zeros(len(maps), maps.shape[1] + 1).scatter_add_(
            1, picks.flatten(1) + 1, torch.ones_like(picks, dtype=maps.dtype).flatten(1)
        )
        ways = torch.cat([counts[:, 1:].repeat_interleave(self.rules.num_places, 1), missing[:, None]], 1)
        return logits, ways, picks

    def _scored(self) -> Tensor:
        """Where among the network's scores each (grasp class, place cell) is found, int64 ``[Q*O*O, W_T*D_T]``.

        The last score is that of every footprint whose corner is not in the tote.
        """
        (tote_w, tote_d, _), offsets = self.rules.tote_size, self.rules.num_offsets
        step, x, y = torch.arange(offsets), torch.arange(tote_w), torch.arange(tote_d)
        found = []
        for parity, (_, _, ref_x, ref_y) in enumerate(self.rules.effectors):
            left = x[:, None] + (step[:, None, None, None] + self.rules.min_offset - ref_x)  # [O, 1, W_T, 1]
            front = y + (step[:, None, None] + self.rules.min_offset - ref_y)  # [O, 1, D_T]
            # The network sees a turned footprint along the item's own axes.
            channel = step[:, None] * offsets + step if parity == 0 else step * offsets + step[:, None]
            inside = (left >= 0) & (left < tote_w) & (front >= 0) & (front < tote_d)
            corner = (parity * tote_w + left) * tote_d + front
            index = corner * offsets**2 + channel[:, :, None, None]
            last = self.rules.num_outcomes * offsets**2
            found.append(torch.where(inside, index, last).flatten(2).flatten(0, 1))
        return torch.cat(found)

    def _pick_classes(self, bin_depth: Tensor) -> Tensor:
        """The grasp class of every pick cell and rotation, int64 ``[N, P, R]``, -1 if the pick fails."""
        failure, offset = self.rules.grasps(self.rules.read_item(bin_depth))
        return torch.where((failure == 0)[..., None], self.rules.grasp_class(offset), -1)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        logits, ways, _ = self._choices(bin_depth, tote_depth)
        return torch.where(ways > 0, logits + ways.clamp(min=1).log(), MASKED)

    def to_action(self, choice: Tensor, bin_depth: Tensor, *_) -> Tensor:
        rules, places = self.rules, self.rules.num_places
        missed = choice == self.classes * places
        wanted = torch.where(missed, -1, choice // places)
        pairs = self._pick_classes(bin_depth).flatten(1) == wanted[:, None]  # [N, P*R]
        pair = pick_one(torch.where(pairs, torch.arange(pairs.shape[1], device=choice.device), -1))
        anywhere = torch.zeros_like(choice)
        if exploration_type() == ExplorationType.RANDOM:
            anywhere = torch.randint(places, choice.shape, device=choice.device)
        place = torch.where(missed, anywhere, choice % places)
        return (pair // rules.rotations * places + place) * rules.rotations + pair % rules.rotations

    def to_choice(self, action: Tensor, bin_depth: Tensor, *_) -> Tensor:
        rules, places = self.rules, self.rules.num_places
        pick, place, rotation = (
            action // (places * rules.rotations),
            action // rules.rotations % places,
            action % rules.rotations,
        )
        grasp = self._pick_classes(bin_depth)[torch.arange(len(action), device=action.device), pick, rotation]
        return torch.where(grasp < 0, self.classes * places, grasp * places + place)

    def action_log_probs(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        logits, ways, picks = self._choices(bin_depth, tote_depth)
        total = torch.where(ways > 0, logits + ways.clamp(min=1).log(), MASKED).logsumexp(1, keepdim=True)
        maps = (logits - total)[:, :-1].unflatten(1, (-1, self.rules.num_places))
        missed = (logits - total)[:, -1:, None].expand(-1, 1, self.rules.num_places)
        rows = torch.cat([missed, maps], 1)  # row 0 is a miss
        batch = torch.arange(len(rows), device=rows.device)[:, None, None]
        return rows[batch, picks + 1].transpose(2, 3).flatten(1)  # [N, P, R, places] -> [N, N_a]


class IndividualGraspPolicy(AtHeuristicPick, GraspPolicy):
    """``individual_grasp`` without masking: heuristic pick; ``fcn_grasp``'s network scores where that can put the item.

    Args: as :class:`GraspPolicy`.
    """

    def _scores(self, bin_depth: Tensor, tote_depth: Tensor, pick: Tensor) -> Tensor:
        row = torch.arange(len(pick), device=pick.device)[:, None]
        grasp = self._pick_classes(bin_depth)[row[:, 0], pick]  # [N, R]
        return self._maps(bin_depth, tote_depth)[row, grasp].transpose(1, 2).flatten(1)


class IndividualOutcomePolicy(OutcomePolicy):
    """``individual_grasp`` with masking: chooses among the distinct footprints that the heuristic pick reaches.

    In a state in which none of them is feasible it chooses among them all, and fails, as it must.

    Args: as :class:`OutcomePolicy`.
    """

    choice_key = "footprint"
    excludes = AtHeuristicPick.excludes
    masks = ("action",)
    in_keys = ["bin_depth", "tote_depth", "action_mask"]

    def _reached(self, bin_depth: Tensor, action_mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """The pick cell, int64 ``[N]``; the outcome of each place and rotation with it, int64 ``[N, W_T * D_T * R]``,
        -1 outside the tote; and which of them to choose among, bool."""
        item = self.rules.read_item(bin_depth)
        pick = self.rules.heuristic_pick(item)
        outcome = self.rules.at_pick(self.rules.action_outcomes(item), pick)
        if action_mask is None:
            return pick, outcome, outcome >= 0
        allowed = self.rules.at_pick(action_mask, pick)
        return pick, outcome, torch.where(allowed.any(1, keepdim=True), allowed, outcome >= 0)

    def forward(self, bin_depth: Tensor, tote_depth: Tensor, action_mask: Tensor) -> Tensor:
        """Logits ``[N, Q * W_T * D_T]``."""
        _, outcome, allowed = self._reached(bin_depth, action_mask)
        return super().forward(bin_depth, tote_depth, count_ways(outcome, allowed, self.rules) > 0)

    def to_action(self, choice: Tensor, bin_depth: Tensor, tote_depth: Tensor, tote_height: Tensor) -> Tensor:
        placements = self.rules.placements_from_depth(bin_depth, tote_depth, tote_height)
        pick, outcome, allowed = self._reached(bin_depth, self.rules.action_mask(placements))
        number = torch.arange(outcome.shape[1], device=choice.device)
        placement = pick_one(torch.where(allowed & (outcome == choice[:, None]), number, -1))
        return pick * len(number) + placement.clamp(min=0)

    def action_log_probs(self, bin_depth: Tensor, tote_depth: Tensor) -> Tensor:
        """Minus infinity for every pick but the heuristic one, and outside the tote."""
        pick, outcome, allowed = self._reached(bin_depth)
        ways = count_ways(outcome, allowed, self.rules)
        share = super().forward(bin_depth, tote_depth, ways > 0).log_softmax(-1) - ways.clamp(min=1).log()
        score = torch.where(allowed, share.gather(1, outcome.clamp(min=0)), -torch.inf)
        return spread_over_actions(score, self.rules, pick)


Policy = FlatPolicy | OutcomePolicy | GraspPolicy


def pick_one(candidates: Tensor) -> Tensor:
    """One entry >= 0 of each row of int64 ``[N, M]``: drawn evenly when exploring, else the lowest; -1 if none."""
    if exploration_type() == ExplorationType.RANDOM:
        draw = torch.rand(candidates.shape, device=candidates.device)
        index = torch.where(candidates >= 0, draw, -1.0).argmax(1, keepdim=True)
    else:
        highest = torch.iinfo(candidates.dtype).max
        index = torch.where(candidates >= 0, candidates, highest).argmin(1, keepdim=True)
    return candidates.gather(1, index)[:, 0]


def fcn4d(rules: Rules, mask_infeasible: bool, **network) -> FlatPolicy:
    """The paper's policy (config ``model=fcn4d``)."""
    return FlatPolicy(rules, mask_infeasible, **network)


def individual_rl(rules: Rules, mask_infeasible: bool, **network) -> IndividualPolicy:
    """The paper's individual planning by reinforcement learning (config ``model=individual_rl``)."""
    return IndividualPolicy(rules, mask_infeasible, **network)


def individual_grasp(rules: Rules, mask_infeasible: bool, **network) -> IndividualOutcomePolicy | IndividualGraspPolicy:
    """Individual planning with the network of ``fcn_grasp`` (config ``model=individual_grasp``)."""
    return (IndividualOutcomePolicy if mask_infeasible else IndividualGraspPolicy)(rules, **network)


def typical(rules: Rules, mask_infeasible: bool, **network) -> TypicalPolicy:
    """The paper's comparison with a fully connected layer (config ``model=typical``)."""
    return TypicalPolicy(rules, mask_infeasible, **network)


def fcn_grasp(rules: Rules, mask_infeasible: bool, **network) -> OutcomePolicy | GraspPolicy:
    """The default policy (config ``model=fcn_grasp``): by outcomes with masking, by grasps without."""
    return (OutcomePolicy if mask_infeasible else GraspPolicy)(rules, **network)


def as_actor(policy: Policy) -> ProbabilisticTensorDictSequential:
    """The policy as TorchRL's PPO loss wants it: observation -> ``logits`` -> a choice and its log-probability."""
    return ProbabilisticTensorDictSequential(
        TensorDictModule(policy, in_keys=policy.in_keys, out_keys=["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=[policy.choice_key],
            distribution_class=Choice,
            default_interaction_type=ExplorationType.RANDOM,
            return_log_prob=True,
            log_prob_key="log_prob",
        ),
    )


def as_collection_policy(policy: Policy) -> TensorDictSequential:
    """The policy as the collector runs it: a choice, its log-probability, and a flat action; no logits are kept."""
    choose = as_actor(policy)
    if policy.choice_key == "action":
        return TensorDictSequential(choose, selected_out_keys=["action", "log_prob"])
    decide = TensorDictModule(
        policy.to_action, in_keys=[policy.choice_key, "bin_depth", "tote_depth", "tote_height"], out_keys=["action"]
    )
    return TensorDictSequential(choose, decide, selected_out_keys=[policy.choice_key, "log_prob", "action"])


def check_sizes(policy: Policy, rules: Rules) -> list[str]:
    """The paper's conditions on sizes in training: eq. 2 on the items, eq. 3 on the bin and the tote.

    Returns:
        A sentence for each condition that a policy with ``fcn_grasp``'s network does not meet; it trains all the same.

    Raises:
        ValueError: for the 4D networks, which cannot learn then.
    """
    field, side = policy.network.receptive_field, rules.longest_side or rules.max_side
    broken = []
    if side > field / 2 + 1:
        broken.append(
            f"items: the longest side is {side}, expected at most {field / 2 + 1:g} (receptive field {field}, eq. 2)."
        )
    for key, size in (("bin_size", rules.bin_size), ("tote_size", rules.tote_size)):
        if min(size[:2]) < field:
            broken.append(
                f"env.{key}={list(size)}: expected sides of at least {field} (receptive field {field}, eq. 3)."
            )
    if broken and isinstance(policy, FlatPolicy):
        raise ValueError(" ".join(broken))
    return broken
