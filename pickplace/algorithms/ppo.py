"""PPO, A2C and TD(lambda): advantages, loss, learning rate and the epochs over one batch."""

import torch
import torch.nn.functional as F
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss
from torchrl.objectives.value import GAE

from pickplace.algorithms.imitation import Phase, imitation_loss
from pickplace.algorithms.sampled_softmax import CANDIDATE_KEYS, as_sampled_actor
from pickplace.policies.base import Policy, as_actor

#: Logged diagnostics, by their names in the loss's output.
DIAGNOSTICS = {
    "loss_objective": "loss_objective",
    "loss_critic": "loss_critic",
    "entropy": "entropy",
    "kl_approx": "approx_kl",
    "clip_fraction": "clip_fraction",
    "explained_variance": "explained_variance",
    "loss_imitation": "loss_imitation",
    "agreement": "agreement",
}


def make_losses(algo: DictConfig, policy: Policy, critic: ValueOperator) -> tuple[GAE, A2CLoss | ClipPPOLoss]:
    """Make the advantage estimator and the loss that ``algo.loss`` names; of ``td`` that whose critic part is used."""
    # TorchRL leaves out a part whose coefficient is 0 at first; with 1 it is computed, so that it can be logged.
    common = {"entropy_coeff": 1.0, "critic_coeff": 1.0, "loss_critic_type": "l2"}
    exact = algo.vine_samples is None
    actor = as_actor(policy) if exact else as_sampled_actor(policy)
    if algo.loss != "a2c":
        clip = {"clip_epsilon": algo.clip_epsilon, "normalize_advantage": exact and algo.normalize_advantage}
        loss = ClipPPOLoss(actor, critic, **clip, **common)
    else:
        loss = A2CLoss(actor, critic, **common)
    loss.entropy_coeff.fill_(float(algo.entropy_coeff))
    loss.critic_coeff.fill_(float(algo.critic_coeff))
    loss.set_keys(action=policy.choice_key, sample_log_prob="log_prob" if exact else CANDIDATE_KEYS[1])
    # A2CLoss does not normalise advantages itself.
    average = algo.loss == "a2c" and algo.normalize_advantage and exact
    advantage = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=critic, average_gae=average, deactivate_vmap=True)
    return advantage, loss


def learning_rate(algo: DictConfig, frames: int, total_frames: int) -> float:
    """Learning rate of the batch that ends at ``frames``.

    It is ``algo.lr``; with ``algo.lr_decay_start`` it falls linearly over the last part of the run, to 0 in the last
    batch.

    Args:
        frames: frames of the run, this batch included.
        total_frames: the run's budget.
    """
    if algo.lr_decay_start is None:
        return algo.lr
    left = (1 - frames / total_frames) / max(1 - algo.lr_decay_start, 1e-9)
    return algo.lr * min(max(left, 0.0), 1.0)


@torch.no_grad()
def add_advantages(batch: TensorDictBase, advantage: GAE, reward_scale: float) -> None:
    """Scale the rewards of a batch ``[N, T]`` in place and write ``advantage`` and ``value_target`` into it."""
    batch["next", "reward"] = batch["next", "reward"] * reward_scale
    batch["next", "terminated"] |= is_bin_empty(batch["next"])
    advantage(batch)


@torch.no_grad()
def afterstates(batch: TensorDictBase, advantage: GAE, reward_scale: float) -> TensorDictBase:
    """Return the totes that the steps of a batch left, ``[N * (T - 1)]``, with TD(lambda) targets as ``value_target``.

    A step from one afterstate to the next is the arrival of an item and its placement. Its reward is that of the
    *next* action of the batch. Where the item that arrived has no place, the environment has ended the episode already,
    together with the action before: the step to that end has reward 0.

    Args:
        batch: ``[N, T]``, at least two steps; its rewards are not scaled.
        advantage: GAE with a critic that reads terms of the tote alone.
    """
    after, keys = batch["next"], advantage.value_network.in_keys
    ended = after["done"][:, :-1]
    reward = torch.where(ended, 0.0, reward_scale * after["reward"][:, 1:])
    steps = after[:, :-1].select(*keys)
    steps["next"] = after[:, 1:].select(*keys).update({"reward": reward, "done": ended, "terminated": ended.clone()})
    advantage(steps)
    return steps.exclude("next").reshape(-1)


def of_taken_choice(advantage: Tensor, candidates: int, normalize: bool) -> Tensor:
    """Return advantages ``[B, candidates, 1]`` of which only the first, that of the taken choice, is not 0.

    It is scaled so that a loss that is a mean over candidates is one over the taken choices.

    Args:
        advantage: GAE's, ``[B, 1]``.
        candidates: ``1 + algo.vine_samples``.
        normalize: to zero mean and unit variance first.
    """
    if normalize:
        advantage = (advantage - advantage.mean()) / advantage.std().clamp(min=1e-6)
    return F.pad(candidates * advantage[:, None], (0, 0, 0, candidates - 1))


def is_bin_empty(state: TensorDictBase) -> Tensor:
    """Whether no item has arrived because the item stream has ended, bool ``[..., 1]``.

    The environment reports that as a truncation. But no reward can follow and no action is taken in that state, so the
    critic would never learn the value with which GAE continues a truncated episode.
    """
    return state["bin_depth"].flatten(-2).amax(-1, keepdim=True) == 0


def update(loss, optimizer, data: TensorDictBase, algo: DictConfig, policy, phase=Phase.REWARD) -> dict[str, float]:
    """Train for ``algo.epochs`` epochs of shuffled minibatches over one batch of frames ``[B]``.

    In phase ``REWARD`` the loss is TorchRL's; in ``CRITIC`` its critic part alone; in ``IMITATION`` that part and the
    imitation of ``data["taught"]``.

    Returns:
        Mean diagnostics, ``train/...``.

    Raises:
        FloatingPointError: if the loss or its gradient is not finite.
    """
    totals: dict[str, Tensor | float] = {}
    steps = 0
    # TorchRL's means over candidates have no weights, and say nothing about the policy.
    left_out = set() if algo.vine_samples is None else {"kl_approx", "clip_fraction"}
    for _ in range(algo.epochs):
        for index in torch.randperm(len(data), device=data.device).split(algo.minibatch_size):
            part = data[index]
            losses = loss(part) if algo.loss != "td" else critic_part(loss, part)
            total = losses["loss_critic"]
            if phase == Phase.REWARD and algo.loss != "td":
                total = losses["loss_objective"] + total + losses["loss_entropy"]
            elif phase == Phase.IMITATION:
                losses["loss_imitation"], losses["agreement"] = imitation_loss(policy, part)
                total = total + losses["loss_imitation"]
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            norm = torch.nn.utils.clip_grad_norm_(loss.parameters(), algo.max_grad_norm)
            if not torch.isfinite(norm + total.detach()):
                parts = {key: value.detach() for key, value in losses.items() if key.startswith("loss_")}
                raise FloatingPointError(f"the loss or its gradient is not finite: {value_ranges({**parts, **part})}.")
            optimizer.step()
            steps += 1
            present = set(losses.keys()) - left_out
            diagnostics = {name: losses[key].detach() for key, name in DIAGNOSTICS.items() if key in present}
            for name, value in {**diagnostics, "grad_norm": norm}.items():
                totals[name] = totals.get(name, 0.0) + value
    return {f"train/{name}": float(value) / steps for name, value in totals.items()}


def critic_part(loss: ClipPPOLoss, data: TensorDictBase) -> dict[str, Tensor]:
    """Return the critic's part of TorchRL's loss, as the whole loss has it; the policy is not asked."""
    error, _, explained = loss.loss_critic(data)
    return {"loss_critic": error.mean(), "explained_variance": explained.mean()}


def value_ranges(values) -> str:
    """Least and greatest value of each floating-point tensor and its number of non-finite values, as one line."""
    words = []
    for name, value in values.items():
        if value.is_floating_point():
            finite = value[value.isfinite()]
            text = f"{finite.min():.3g} to {finite.max():.3g}" if len(finite) else "no number"
            bad = value.numel() - len(finite)
            words.append(f"{name} {text}" + f" ({bad} of {value.numel()} not finite)" * bool(bad))
    return "; ".join(words)
