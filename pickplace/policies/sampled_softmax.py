"""The softmax over a few sampled choices, for a loss whose policy has many choices.

A gradient step through the softmax over all ``N_a`` flat actions computes every logit forward and backward. Here the
loss computes only those of the *candidates*: the choice that was taken and some more, all drawn from the policy that
collected (see also :mod:`pickplace.training.vine`). The normaliser of the softmax is estimated from them by
self-normalised importance sampling (Bengio and Senecal 2008). With ``pi`` the collecting policy, ``l`` the new logits
and ``m + 1`` candidates ``a_j``::

    d_j = l(a_j) - log pi(a_j)
    log pi_new(a_i) = log pi(a_i) + d_i - log(mean_j exp(d_j))

At the policy that collected, the expected gradient of the log-probability and of the entropy is ``m / (m + 1)`` times
the exact one.
"""

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType

from pickplace.policies.base import Choice, Policy, act_module

#: The entries of a frame that the loss reads: the candidates, int64 ``[N, 1 + samples]``, the taken choice first, and
#: their log-probabilities under the policy that collected, float32 of the same shape.
CANDIDATE_KEYS = ("candidates", "candidate_log_prob")


class SampledSoftmax(Categorical):
    """The distribution of a policy, estimated at candidates that an earlier policy drew.

    Args:
        logits: of the candidates under the new policy, up to a constant, ``[N, 1 + samples]``.
        log_prob: of the candidates under the policy that drew them, same shape.
    """

    def __init__(self, logits: Tensor, log_prob: Tensor):
        super().__init__(logits=logits - log_prob, validate_args=False)
        self.candidate_log_prob = log_prob + self.logits + math.log(logits.shape[-1])

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the estimated log-probability of every candidate, ``[N, 1 + samples]``, whatever ``value`` is."""
        return self.candidate_log_prob

    def entropy(self) -> Tensor:
        """Return the estimated entropy over all choices, ``[N]``; in nats."""
        return -(self.probs * self.candidate_log_prob).sum(-1)


class CandidateLogits(TensorDictModuleBase):
    """The module that writes ``candidate_logits`` ``[N, 1 + samples]``."""

    def __init__(self, policy: Policy):
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = [*policy.in_keys, CANDIDATE_KEYS[0]], ["candidate_logits"]

    def forward(self, frame: TensorDictBase) -> TensorDictBase:
        return frame.set("candidate_logits", self.policy.choice_logits(frame, frame["candidates"]))


def as_sampled_actor(policy: Policy) -> ProbabilisticTensorDictSequential:
    """Return the policy as TorchRL's losses want it, for frames with :data:`CANDIDATE_KEYS`."""
    return ProbabilisticTensorDictSequential(
        CandidateLogits(policy),
        ProbabilisticTensorDictModule(
            in_keys={"logits": "candidate_logits", "log_prob": CANDIDATE_KEYS[1]},
            out_keys=[policy.choice_key],
            distribution_class=SampledSoftmax,
            default_interaction_type=ExplorationType.RANDOM,
            return_log_prob=True,
            log_prob_key="log_prob",
        ),
    )


def as_sampling_policy(policy: Policy, samples: int) -> TensorDictSequential:
    """Return the policy as the collector runs it: choice, log-probability, flat action and the candidates.

    Args:
        policy: the policy.
        samples: candidates beside the choice that is taken.
    """

    def draw(logits: Tensor) -> tuple[Tensor, ...]:
        choice = Choice(logits)
        candidates = choice.sample(torch.Size((1 + samples,))).T.contiguous()
        log_prob = choice.logits.gather(1, candidates)
        return candidates[:, 0], log_prob[:, 0], candidates, log_prob

    keys = [policy.choice_key, "log_prob", *CANDIDATE_KEYS]
    draw_candidates = TensorDictModule(draw, in_keys=["logits"], out_keys=keys)
    selected = list(dict.fromkeys([*keys, "action"]))
    return TensorDictSequential(policy, draw_candidates, act_module(policy), selected_out_keys=selected)
