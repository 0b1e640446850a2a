"""The softmax over a few sampled choices, for a loss whose policy has many choices.

A gradient step through the softmax over all ``N_a`` flat actions computes every logit forward and backward. Here the
loss computes only those of the *candidates*, which the policy that collected draws without replacement (see also
:mod:`pickplace.training.vine`): the choices with the greatest log-probability plus Gumbel noise (Kool, van Hoof and
Welling, Stochastic Beams and Where to Find Them, 2019). The first of them is a draw from the policy, and is taken.

An expectation under the policy is estimated by a weighted mean over the candidates. With ``pi`` the policy that
collected and ``k`` the greatest noisy log-probability that is left out::

    w_i = pi(a_i) / (1 - exp(-exp(log pi(a_i) - k))), scaled to a sum of 1

The normaliser of a new policy with logits ``l`` is such an expectation, too::

    d_i = l(a_i) - log pi(a_i)
    log pi_new(a_i) = log pi(a_i) + d_i - log(sum_j w_j exp(d_j))

Once every choice is a candidate, all of this is exact. With few, gradients are a little short: by up to a tenth with 9.
"""

import torch
import torch.nn.functional as F
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

from pickplace.policies.base import MASKED, Policy, act_module

#: The entries of a frame that the loss reads, each ``[N, 1 + samples]``: the candidates, int64, the taken choice first;
#: their log-probabilities under the policy that collected; and the logarithms of their weights, both float32.
CANDIDATE_KEYS = ("candidates", "candidate_log_prob", "candidate_log_weight")


class SampledSoftmax(Categorical):
    """The distribution of a policy, estimated at candidates that an earlier policy drew.

    Args:
        logits: of the candidates under the new policy, up to a constant, ``[N, 1 + samples]``.
        log_prob: of the candidates under the policy that drew them, same shape.
        log_weight: logarithms of the candidates' weights, same shape.
    """

    def __init__(self, logits: Tensor, log_prob: Tensor, log_weight: Tensor):
        change = logits - log_prob
        super().__init__(logits=change + log_weight, validate_args=False)
        self.candidate_log_prob = logits - (change + log_weight).logsumexp(-1, keepdim=True)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the estimated log-probability of every candidate, ``[N, 1 + samples]``, whatever ``value`` is."""
        return self.candidate_log_prob

    def entropy(self) -> Tensor:
        """Return the estimated entropy over all choices, ``[N]``; in nats."""
        return -(self.probs * self.candidate_log_prob).sum(-1)


def draw_candidates(logits: Tensor, samples: int) -> tuple[Tensor, Tensor, Tensor]:
    """Draw choices without replacement; return the three entries of :data:`CANDIDATE_KEYS`.

    Where a mask allows too few, the taken one stands for each that is missing, with a weight of 0.

    Args:
        logits: of all choices, ``[N, choices]``; :data:`MASKED` for those that a mask forbids.
        samples: candidates beside the choice that is taken; fewer if there are not so many choices.
    """
    samples = min(samples, logits.shape[1] - 1)
    one_more = 2 + samples - logits.shape[1]  # 1 where every choice is a candidate: none is left out
    every = F.pad(logits, (0, max(one_more, 0)), value=-torch.inf).log_softmax(1)
    noisy = every - torch.empty_like(every).exponential_().clamp(min=1e-30).log()
    score, order = noisy.topk(2 + samples)
    candidates, left_out = order[:, :-1], score[:, -1:]
    log_prob = every.gather(1, candidates)
    log_weight = log_prob - (-(log_prob - left_out).exp()).expm1().neg().log()
    absent = log_prob < MASKED / 2
    log_weight = log_weight.masked_fill(absent, -torch.inf).log_softmax(1)
    return (
        torch.where(absent, candidates[:, :1], candidates),
        torch.where(absent, log_prob[:, :1], log_prob),
        log_weight,
    )


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
            in_keys={"logits": "candidate_logits", "log_prob": CANDIDATE_KEYS[1], "log_weight": CANDIDATE_KEYS[2]},
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
        candidates, log_prob, log_weight = draw_candidates(logits, samples)
        return candidates[:, 0], log_prob[:, 0], candidates, log_prob, log_weight

    keys = [policy.choice_key, "log_prob", *CANDIDATE_KEYS]
    sampler = TensorDictModule(draw, in_keys=["logits"], out_keys=keys)
    selected = list(dict.fromkeys([*keys, "action"]))
    return TensorDictSequential(policy, sampler, act_module(policy), selected_out_keys=selected)
