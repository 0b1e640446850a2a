"""Search on top of a trained policy."""

import itertools

import torch
from torch import Tensor

from pickplace.common.validate import check_bytes, number, or_null, refuse_if, whole_number
from pickplace.items.arrival import refill
from pickplace.items.distributions import ItemDistribution, check_seed, search_items
from pickplace.planners.base import MapPlanner
from pickplace.policies.base import MASKED, EstimatesValue, Policy, ScoresFootprints, best_choice
from pickplace.rules.bin import admit_coming_items
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item, Observation
from pickplace.rules.masks import PlacingMaps, first_action_reaching, placing_maps
from pickplace.rules.observation import SeenItems, check_terms, observe
from pickplace.rules.state import State
from pickplace.rules.step import put_down


class Lookahead(MapPlanner):
    """Plays out the policy's most probable choices, and departs from the policy only where a gain is certain enough.

    After each candidate the policy itself decides, on the same imagined item streams for all (common random numbers).
    So their differences are known far better than their values. Close candidates get more streams. The policy's own
    choice stands unless another one is better by ``confidence`` standard errors of the mean difference. This is a
    rollout algorithm (Tesauro & Galperin 1996): to that confidence, the items' noise cannot make it worse than its
    policy. The critic's error could, where the policy fills nearly all. So a gain that the critic predicts must be
    confirmed by playing both choices out to the end, unless the policy itself is derived from the critic.

    Imagined items come from the item distribution, never from the stream that is played. The first items of all streams
    are spread over its kinds, so with as many streams as kinds their mean is exact. The items in the bin and in the
    preview are known, and played out before them.

    Args:
        cell: the sizes.
        policy: ``fcn_grasp`` or ``afterstate``, trained with a mask.
        items: the item distribution; for a sequence, recorded or cut, its sizes with equal probability.
        candidates: number of the policy's most probable choices that are played out.
        critic: a function from observations to values ``[N, 1]``, in volume; None: there is none.
        terms: of the observation, by key; None: the standard ones.
        horizon: number of items after which the critic judges the state; None, or without a critic: to the end.
        samples: number of imagined streams in the first round, and to confirm a gain; each later round doubles it.
        rounds: the greatest number of rounds.
        confidence: standard errors by which a candidate must beat the policy's choice.
        seed: of the imagined items.
    """

    name = "lookahead"
    needs = ("policy", "critic", "items", "terms")

    def __init__(
        self,
        cell: CellSpec,
        policy: Policy,
        items: ItemDistribution,
        critic=None,
        terms=None,
        horizon: int | None = 2,
        candidates: int = 4,
        samples: int = 32,
        rounds: int = 2,
        confidence: float = 2.0,
        seed: int = 0,
    ):
        self.candidates = whole_number("planner.candidates", candidates, most=1_000)
        self.samples = whole_number("planner.samples", samples, 2, 10_000)
        self.rounds = whole_number("planner.rounds", rounds, most=10)
        self.confidence = number("planner.confidence", confidence)
        or_null(whole_number, "planner.horizon", horizon)
        refuse_if(
            not isinstance(policy, ScoresFootprints),
            "planner=lookahead: expected a checkpoint of model=fcn_grasp or afterstate, with a mask.",
        )
        self.cell, self.policy, self.items = cell, policy, search_items(items)
        self.terms = check_terms(terms, cell)
        self.critic, self.horizon = critic, None if critic is None else horizon
        self.seed, self._decisions = check_seed(seed, "planner.seed"), 0

    @torch.no_grad()
    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        streams = self.candidates * self.samples * 2 ** (self.rounds - 1)
        check_bytes(
            f"planner.candidates={self.candidates}, planner.samples={self.samples}, planner.rounds={self.rounds}",
            len(state.surface) * streams * (16 * self.cell.num_choices + 10 * cell.record_bytes),
            state.surface.device,
        )
        logits = self.policy.footprint_logits(observation, self.policy.with_cell(cell).ranked(maps))
        # Among equals the first, like the policy itself.
        value, choice = (part[:, : self.candidates] for part in logits.sort(dim=1, descending=True, stable=True))
        best = self._best(State.from_observation(observation), choice, value > MASKED / 2)
        return first_action_reaching(cell, maps, choice.gather(1, best[:, None])[:, 0])

    def restart(self) -> None:
        self._decisions = 0

    def evaluation_facts(self) -> dict:
        return {"candidates": "all", "mask_at_decision": True}  # like planner=policy

    def _best(self, state: State, choice: Tensor, open_: Tensor) -> Tensor:
        """Return the number of the candidate to play, int64 ``[N]``.

        Args:
            choice: int64 ``[N, M]``, footprints; the policy's own choice is the first.
            open_: mask of the candidates that may be played, bool ``[N, M]``.
        """
        total = torch.zeros(choice.shape, dtype=torch.float64, device=choice.device)  # of the differences to the first
        squares, count = torch.zeros_like(total), torch.zeros_like(total)
        mean = error = total
        for streams in [self.samples * 2**done for done in range(self.rounds)]:
            open_ = open_ & (open_.sum(1, keepdim=True) > 1)  # nothing to decide where one is left
            row, column = open_.nonzero(as_tuple=True)
            if len(row) == 0:
                break
            volume = self._returns(state, row, choice[row, column], streams, self.horizon)  # [rows, streams]
            first = volume[(column == 0).nonzero()[:, 0]]  # one for each problem that is open
            difference = volume - first[torch.unique_consecutive(row, return_inverse=True)[1]]
            total[row, column] += difference.sum(1)
            squares[row, column] += difference.square().sum(1)
            count[row, column] += streams
            mean = total / count.clamp(min=1)
            error = ((squares / count.clamp(min=1) - mean.square()).clamp(min=0) / (count - 1).clamp(min=1)).sqrt()
            hopeless = mean + self.confidence * error < (mean - self.confidence * error).amax(1, keepdim=True)
            hopeless |= (count > 0) & (error == 0) & (mean <= 0)
            hopeless[:, 0] = False
            open_ = open_ & ~hopeless
        surely = (count > 0) & (mean > self.confidence * error) & (mean > 0)
        best = torch.where(surely, mean, 0.0).argmax(1)
        is_known = self.horizon is None or isinstance(self.policy, EstimatesValue)
        return best if is_known else self._confirm(best, state, choice)

    def _confirm(self, best: Tensor, state: State, choice: Tensor) -> Tensor:
        """Return ``best``, int64 ``[N]``, without the departures that gain nothing when played out to the end.

        Two standard errors guard against the items' noise, not against the critic's own error. Where the policy fills
        nearly all, that error is larger than the difference between candidates.
        """
        row = best.nonzero()[:, 0]
        if len(row) == 0:
            return best
        both = row.repeat_interleave(2)  # the policy's own choice and the candidate, on the same items
        column = torch.stack([torch.zeros_like(row), best[row]], 1).flatten()
        volume = self._returns(state, both, choice[both, column], self.samples, None).mean(1)
        return best.index_put((row,), torch.where(volume[1::2] > volume[::2], best[row], 0))

    def _returns(self, state: State, row: Tensor, choice: Tensor, streams: int, horizon) -> Tensor:
        """Return the volume placed by choices and by the policy after them, float64 ``[M, streams]``.

        Args:
            row, choice: the problem and the footprint, int64 ``[M]``.
            streams, horizon: as in :meth:`_play_out`.
        """
        state, placed = put_down(self.cell, state.rows(row), choice)
        return placed.volume.double()[:, None] + self._play_out(state, row, streams, horizon)

    def _play_out(self, state: State, problem: Tensor, streams: int, horizon) -> Tensor:
        """Return the volume that the policy goes on to place, float64 ``[M, streams]``.

        Args:
            state: of ``M`` problems, before items arrive.
            problem: int64 ``[M]``; equal ones get equal items.
            horizon: number of items after which the critic judges the state; None: played out to the end.
        """
        cell, policy, critic_keys = self.cell, self.policy, getattr(self.critic, "in_keys", ())
        # A critic that does not see the bin values what a placement leaves, before the next item arrives.
        judges_before = critic_keys and "bin_depth" not in critic_keys
        self._decisions += 1
        state, problem = state.repeat(streams), problem.repeat_interleave(streams, 0)
        stream = torch.arange(len(problem), device=problem.device) % streams
        # The address of an imagined item: the planner's seed, this call, the problem and the stream.
        seed = problem * 1_000_003 + self._decisions * 7_919 + self.seed
        volume = torch.zeros(len(problem), dtype=torch.float64, device=problem.device)
        arrived, row = torch.zeros_like(problem), torch.arange(len(problem), device=problem.device)
        # Items are spread only if the bin holds one: with several, the effect has not been measured.
        source = _Imagined(self.items, streams) if cell.bin_items == 1 else self.items
        for step in itertools.count():
            if step == horizon and judges_before:
                seen = observe({**self.terms, "items": SeenItems()}, cell, state, critic_keys)
                volume[row] += self.critic(seen)[:, 0].double()
                break
            address = seed[row], stream[row], arrived
            state, open_ = admit_coming_items(cell, state)
            items, arrived = refill(cell, source, "train", *address, state.items, open_, state.episode)
            state = state._replace(items=items)
            mask = policy.ranked(placing_maps(cell, state))
            going = mask.view(torch.uint8).amax(1).nonzero()[:, 0]
            if len(going) < len(row):
                row, state, mask, arrived = row[going], state.rows(going), mask[going], arrived[going]
            if len(row) == 0:
                break
            observation = observe(self.terms, cell, state, [*policy.in_keys, *critic_keys])
            if step == horizon:
                volume[row] += self.critic(observation)[:, 0].double()
                break
            choice = best_choice(policy.footprint_logits(observation, mask))
            state, placed = put_down(cell, state, choice)
            volume[row] += placed.volume.double()
        return volume.view(-1, streams)


class _Imagined(ItemDistribution):
    """The items of imagined streams. The first items are spread over the distribution.

    Args:
        items: the item distribution.
        count: number of streams.
    """

    def __init__(self, items: ItemDistribution, count: int):
        self.items, self.count = items, count
        self.has_corners, self.mixes = items.has_corners, items.mixes

    def sample(self, stream: str, seed: Tensor, episode: Tensor, step: Tensor, bin_size, mix=None) -> Item:
        item = self.items.sample(stream, seed, episode, step, bin_size, **self.items.mix_arguments(mix))
        first = self.items.spread(seed, episode, self.count, bin_size, **self.items.mix_arguments(mix))
        return Item(*(torch.where(step == 0, *parts) for parts in zip(first, item, strict=True)))
