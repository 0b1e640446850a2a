"""The softmax over a few sampled choices, for a loss whose policy has many choices.

A gradient step through the softmax over all ``N_a`` flat actions computes every logit forward and backward. Here the
loss computes only the logits of the *candidates*. The first one is a draw from ``pi``, the policy that collected, and
is taken. The loss learns from it alone (``algo.advantages=gae``), or from all (``vine``). The others are drawn without
replacement from ``q``, which is ``pi`` at a higher temperature, so that rare choices are tried more often. They are the
choices with the greatest log-probability plus Gumbel noise (Kool, van Hoof and Welling, Stochastic Beams and Where to
Find Them, 2019).

An expectation under the policy is estimated by a weighted mean over the candidates. The weight is the probability
of a choice divided by its chance to be a candidate; ``k`` is the greatest noisy log-probability that is left out::

    p_i = 1 - exp(-exp(log q(a_i) - k))
    w_i = pi(a_i) / (pi(a_i) + (1 - pi(a_i)) p_i), scaled to a sum of 1

The normaliser of a new policy with logits ``l`` is such an expectation, too::

    d_i = l(a_i) - log pi(a_i)
    log pi_new(a_i) = log pi(a_i) + d_i - log(sum_j w_j exp(d_j))

If every choice is a candidate, this is exact. With few candidates, gradients are too small: by up to a tenth with 9.
"""

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

from pickplace.policies.base import MASKED, Policy, act_module

#: The entries of a frame that the loss reads, each ``[N, 1 + samples]``: the candidates, int64, the taken choice first;
#: their log-probabilities under the policy that collected; and the logarithms of their weights, both float32.
CANDIDATE_KEYS = ("candidates", "candidate_log_prob", "candidate_log_weight")


#: Greatest growth of a candidate's probability that the loss sees, as a logarithm: a greater ratio could overflow. Only
#: a choice whose probability was below exp(-30) can grow more, and its weight is as small.
MAX_GROWTH = 30.0


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
        self.earlier_log_prob = log_prob
        self.candidate_log_prob = logits - (change + log_weight).logsumexp(-1, keepdim=True)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the estimated log-probability of every candidate, ``[N, 1 + samples]``, whatever ``value`` is."""
        return self.candidate_log_prob.minimum(self.earlier_log_prob + MAX_GROWTH)

    def entropy(self) -> Tensor:
        """Return the estimated entropy over all choices, ``[N]``; in nats."""
        return -(self.probs * self.candidate_log_prob).sum(-1)


def draw_candidates(logits: Tensor, samples: int, temperature: float) -> tuple[Tensor, Tensor, Tensor]:
    """Draw choices, all different; return the three entries of :data:`CANDIDATE_KEYS`.

    If a mask allows too few, the taken choice fills the missing places, with a weight of 0.

    Args:
        logits: of all choices, ``[N, choices]``; :data:`MASKED` for those that a mask forbids.
        samples: number of candidates beside the taken choice, at most the number of other choices.
        temperature: divides the logits for these candidates; 1: they are drawn from the policy itself.
    """
    samples = min(samples, logits.shape[1] - 1)
    every = logits.log_softmax(1)
    taken = _add_noise(every).argmax(1, keepdim=True)
    finite = (every / temperature).clamp(min=MASKED)  # at a low temperature MASKED would become infinite
    others = finite.scatter(1, taken, -torch.inf)
    scale = others.logsumexp(1, keepdim=True)
    score, order = _add_noise(others - scale).topk(1 + samples)  # the taken one cannot be drawn again
    candidates = torch.cat([taken, order[:, :-1]], 1)
    log_prob = every.gather(1, candidates)
    among_others = -(-(log_prob / temperature - scale - score[:, -1:]).exp()).expm1()
    chance = log_prob.exp() + (1 - log_prob.exp()) * among_others
    absent = log_prob < MASKED / 2
    log_weight = (log_prob - chance.log()).masked_fill(absent, -torch.inf).log_softmax(1)
    return (
        torch.where(absent, candidates[:, :1], candidates),
        torch.where(absent, log_prob[:, :1], log_prob),
        log_weight,
    )


def _add_noise(log_prob: Tensor) -> Tensor:
    """Return log-probabilities plus Gumbel noise: the greatest is a draw, the greatest few are draws without
    replacement."""
    return log_prob - torch.empty_like(log_prob).exponential_().clamp(min=1e-30).log()


class CandidateLogits(TensorDictModuleBase):
    """The module that writes ``candidate_logits`` ``[N, 1 + samples]``."""

    def __init__(self, policy: Policy):
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = [*policy.in_keys, CANDIDATE_KEYS[0]], ["candidate_logits"]

    def forward(self, frame: TensorDictBase) -> TensorDictBase:
        return frame.set("candidate_logits", self.policy.choice_logits(frame, frame["candidates"]))


def as_sampled_actor(policy: Policy) -> ProbabilisticTensorDictSequential:
    """Return the policy for TorchRL's losses, which reads frames with :data:`CANDIDATE_KEYS`."""
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


def as_sampling_policy(policy: Policy, samples: int, temperature: float) -> TensorDictSequential:
    """Return the policy for the collector: it writes choice, log-probability, flat action and the candidates.

    Args:
        policy: the policy.
        samples, temperature: as in :func:`draw_candidates`.
    """

    def draw(logits: Tensor) -> tuple[Tensor, ...]:
        candidates, log_prob, log_weight = draw_candidates(logits, samples, temperature)
        return candidates[:, 0], log_prob[:, 0], candidates, log_prob, log_weight

    keys = [policy.choice_key, "log_prob", *CANDIDATE_KEYS]
    return TensorDictSequential(
        policy,
        TensorDictModule(draw, in_keys=["logits"], out_keys=keys),
        act_module(policy),
        selected_out_keys=[*dict.fromkeys([*keys, "action"])],
    )
