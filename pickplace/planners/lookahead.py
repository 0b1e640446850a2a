"""Search on top of a trained policy."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace.policies.actors import MASKED, OutcomePolicy
from pickplace.task.geometry import Rules
from pickplace.task.items import ItemDistribution, check_seed, imagined


class Lookahead:
    """Plays the policy's likeliest choices out, and departs from the policy only when that surely pays.

    Each candidate is followed by the policy itself, on the same imagined item streams as the others (common random
    numbers), so that their difference is known far better than their values. More streams are spent where candidates
    are close. The policy's own choice stands unless another's mean difference to it is positive by ``confidence``
    standard errors: a rollout algorithm (Tesauro & Galperin 1996) that the items' noise cannot make worse than its
    policy, to that confidence. A critic that errs could, where the policy fills nearly all: what wins by its judgement
    must gain without it too, both played out to the end. The imagined items come from the item distribution, never
    from the stream that is played.

    Args:
        rules: the task's sizes.
        policy: an ``fcn_grasp`` policy that was trained with a mask.
        items: the item distribution; of a recorded stream, its sizes, equally likely.
        candidates: how many of the policy's most probable choices are played out.
        critic: the value of a state, ``(bin_depth, tote_depth) -> [N, 1]``, in cells; None: there is none.
        horizon: items after which the critic judges the state; None, or without a critic: played out to the end.
        samples: imagined streams in the first round, each later round doubles them; and of what is played to the end.
        rounds: the greatest number of rounds.
        confidence: standard errors by which a candidate must beat the policy's choice.
        seed: of the imagined items.
    """

    name = "lookahead"

    def __init__(
        self,
        rules: Rules,
        policy: torch.nn.Module,
        items: ItemDistribution,
        critic=None,
        horizon: int | None = 2,
        candidates: int = 4,
        samples: int = 32,
        rounds: int = 2,
        confidence: float = 2.0,
        seed: int = 0,
    ):
        whole = {"candidates": (candidates, 1), "samples": (samples, 2), "rounds": (rounds, 1)}
        whole |= {"horizon": (horizon, 1)} if horizon is not None else {}
        for key, (value, least) in whole.items():
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise ValueError(f"planner.{key}={value!r}: expected a whole number >= {least}.")
        if not isinstance(confidence, (int, float)) or isinstance(confidence, bool) or not confidence >= 0:
            raise ValueError(f"planner.confidence={confidence!r}: expected a number >= 0.")
        if not isinstance(policy, OutcomePolicy):
            raise ValueError("planner=lookahead: expected a checkpoint of model=fcn_grasp, trained with a mask.")
        self.rules, self.policy, self.critic = rules, policy, critic
        self.horizon = horizon if critic is not None else None
        self.items = imagined(items)
        self.candidates, self.samples, self.rounds, self.confidence = candidates, samples, rounds, confidence
        self.seed, self._decisions = check_seed(seed, "planner.seed"), 0

    @torch.no_grad()
    def decide(self, observation: TensorDictBase) -> Tensor:
        rules, policy = self.rules, self.policy
        bin_depth, tote_depth = observation["bin_depth"], observation["tote_depth"]
        tote_height = observation["tote_height"].reshape(-1)
        heights = (tote_height[:, None, None] - tote_depth).int()
        placements = rules.placements(heights, tote_height, rules.read_item(bin_depth))
        logits = policy(bin_depth, tote_depth, rules.outcome_mask(placements).flatten(1))
        value, choice = torch.sort(
            logits, dim=1, descending=True, stable=True
        )  # of equals the first, as the policy itself plays
        value, choice = value[:, : self.candidates], choice[:, : self.candidates]
        best = self._best(heights, tote_height, placements, choice, value > MASKED / 2)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            outcome = choice.gather(1, best[:, None])[:, 0]
            return policy.to_action(outcome, bin_depth, tote_depth, tote_height).clamp(min=0)

    def _best(self, heights, tote_height, placements, choice, open_: Tensor) -> Tensor:
        """Which candidate to play, int64 ``[N]``.

        Args:
            choice: int64 ``[N, M]``, outcomes; the policy's own is the first.
            open_: bool ``[N, M]``, which may be played.
        """
        total = torch.zeros(choice.shape, dtype=torch.float64, device=choice.device)  # of the differences to the first
        squares, count = torch.zeros_like(total), torch.zeros_like(total)
        mean, error = total, torch.full_like(total, torch.inf)
        streams = self.samples
        for _ in range(self.rounds):
            open_ = open_ & (open_.sum(1, keepdim=True) > 1)  # nothing to decide where one is left
            row, column = open_.nonzero(as_tuple=True)
            if len(row) == 0:
                break
            after = self.rules.put_down(heights[row], placements.rows(row), choice[row, column])
            volume = self._play_out(after, tote_height[row], row, streams, self.horizon)  # [rows, streams]
            first = volume[(column == 0).nonzero()[:, 0]]  # one for each problem that is open
            problem = torch.unique_consecutive(row, return_inverse=True)[1]
            difference = volume - first[problem]
            total[row, column] += difference.sum(1)
            squares[row, column] += difference.square().sum(1)
            count[row, column] += streams
            mean = total / count.clamp(min=1)
            error = ((squares / count.clamp(min=1) - mean.square()).clamp(min=0) / (count - 1).clamp(min=1)).sqrt()
            hopeless = mean + self.confidence * error < (mean - self.confidence * error).amax(1, keepdim=True)
            hopeless |= (count > 0) & (error == 0) & (mean <= 0)
            hopeless[:, 0] = False
            open_ = open_ & ~hopeless
            streams *= 2
        surely = (count > 0) & (mean > self.confidence * error) & (mean > 0)
        best = torch.where(surely, mean, 0.0).argmax(1)
        return best if self.horizon is None else self._confirm(best, heights, tote_height, placements, choice)

    def _confirm(self, best: Tensor, heights, tote_height, placements, choice) -> Tensor:
        """``best``, int64 ``[N]``, without the departures that do not gain when played out to the end, with no critic.

        Two standard errors guard against the items' noise, not against the critic's own error, which outweighs what
        candidates differ by where the policy fills nearly all.
        """
        row = best.nonzero()[:, 0]
        if len(row) == 0:
            return best
        both = row.repeat_interleave(2)  # the policy's own choice and the candidate, on the same items
        column = torch.stack([torch.zeros_like(row), best[row]], 1).flatten()
        after = self.rules.put_down(heights[both], placements.rows(both), choice[both, column])
        volume = self._play_out(after, tote_height[both], both, self.samples, None).mean(1)
        gain = volume[1::2] - volume[::2]
        return best.index_put((row,), torch.where(gain > 0, best[row], 0))

    def _play_out(self, heights: Tensor, tote_height: Tensor, problem: Tensor, streams: int, horizon) -> Tensor:
        """Volume that the policy goes on to place, float64 ``[M, streams]``.

        Args:
            heights: int32 ``[M, W_T, D_T]``.
            problem: int64 ``[M]``; equal ones meet equal items.
            horizon: items after which the critic judges the state; None: played out to the end.
        """
        rules, items = self.rules, self.items
        self._decisions += 1
        heights, tote_height, problem = (x.repeat_interleave(streams, 0) for x in (heights, tote_height, problem))
        stream = torch.arange(len(heights), device=heights.device) % streams
        # The address of an imagined item: the planner's seed, this call, the problem and the stream.
        seed = problem * 1_000_003 + self._decisions * 7_919 + self.seed
        volume = torch.zeros(len(heights), dtype=torch.float64, device=heights.device)
        row = torch.arange(len(heights), device=heights.device)
        step = 0
        while len(row):
            item = items.sample("train", seed[row], stream[row], torch.full_like(row, step), rules.bin_size)
            placements = rules.placements(heights, tote_height[row], item)
            mask = rules.outcome_mask(placements).flatten(1)
            going = mask.view(torch.uint8).amax(1).nonzero()[:, 0]
            if len(going) < len(row):
                row, heights, mask, placements = row[going], heights[going], mask[going], placements.rows(going)
                item = placements.item
            if len(row) == 0:
                break
            bin_depth, tote_depth = rules.bin_depth(item), (tote_height[row, None, None] - heights).float()
            if step == horizon:
                volume[row] += self.critic(bin_depth, tote_depth)[:, 0].double()
                break
            outcome = self.policy(bin_depth, tote_depth, mask).argmax(1)
            heights = rules.put_down(heights, placements, outcome)
            volume[row] += (item.w * item.d * item.h).double()
            step += 1
        return volume.view(-1, streams)
