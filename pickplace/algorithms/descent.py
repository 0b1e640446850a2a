"""Epochs of shuffled minibatches over a batch: the gradient steps of most algorithms."""

import logging
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pickplace.algorithms.base import Algorithm, At, Objective, Task, load_optimizer
from pickplace.common.validate import number, or_null, whole_number
from pickplace.policies.base import Policy, as_collection_policy

log = logging.getLogger(__name__)

#: Logged diagnostics, by their names in a loss's output.
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

MAX_WEIGHT = 1e38  # float32 ends there


class MinibatchDescent(Algorithm):
    """Base class of algorithms that minimise a loss by Adam, in epochs of shuffled minibatches over each batch.

    A subclass sets :attr:`optimizer` by :meth:`use_parameters`.

    Args:
        policy: the policy that is trained.
        task: facts of the training.
        epochs: passes over each batch.
        minibatch_size: frames of each gradient step.
        lr: Adam's step size.
        lr_decay_start: share of the budget after which ``lr`` falls linearly to 0; None: constant.
        max_grad_norm: gradient norm above which gradients are scaled down.
    """

    def __init__(
        self,
        policy: Policy,
        task: Task,
        epochs: int,
        minibatch_size: int,
        lr: float,
        lr_decay_start: float | None,
        max_grad_norm: float,
    ):
        self.policy, self.task = policy, task
        self.epochs = whole_number("algo.epochs", epochs, most=1_000)
        self.minibatch_size = whole_number("algo.minibatch_size", minibatch_size)
        self.lr = number("algo.lr", lr, most=MAX_WEIGHT)
        self.lr_decay_start = or_null(number, "algo.lr_decay_start", lr_decay_start, 0, 1)
        self.max_grad_norm = number("algo.max_grad_norm", max_grad_norm, 1e-9, MAX_WEIGHT)

    def acting_policy(self) -> TensorDictModuleBase:
        return as_collection_policy(self.policy)

    def use_parameters(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Make the optimizer of these parameters."""
        self.parameters = [*parameters]
        self.optimizer = torch.optim.Adam(self.parameters, lr=self.lr, eps=1e-5)

    def descend(self, data: TensorDictBase, at: At, objective: Objective) -> dict[str, float]:
        """Minimise an objective for ``epochs`` epochs of shuffled minibatches over frames ``[B]``.

        Returns:
            Mean diagnostics and the learning rate, ``train/...``.

        Raises:
            FloatingPointError: if the loss or its gradient is not finite.
        """
        rate = self.learning_rate(at)
        if at.before == 0 and rate == 0 < self.lr:
            log.warning("total_frames=%d: the only batch has learning rate 0; nothing is learnt", at.total)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        history: list[dict[str, Tensor]] = []  # diagnostics of each step
        for _ in range(self.epochs):
            for index in torch.randperm(len(data), device=data.device).split(self.minibatch_size):
                part = data[index]
                total, losses = objective(part)
                self.optimizer.zero_grad(set_to_none=True)
                total.backward()
                norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
                if not torch.isfinite(norm + total.detach()):
                    parts = {key: value.detach() for key, value in losses.items() if key.startswith("loss_")}
                    values = {**parts, **part}.items()
                    ranges = "; ".join(
                        f"{key} {value_range(value)}" for key, value in values if value.is_floating_point()
                    )
                    raise FloatingPointError(
                        f"the loss or its gradient is not finite: {ranges}; expected a smaller algo.lr."
                    )
                self.optimizer.step()
                diagnostics = {name: losses[key].detach() for key, name in DIAGNOSTICS.items() if key in losses}
                history.append({**diagnostics, "grad_norm": norm})
        means = {f"train/{name}": float(sum(each[name] for each in history)) / len(history) for name in history[0]}
        return {**means, "train/lr": rate}

    def learning_rate(self, at: At) -> float:
        """Return the learning rate of a batch; if it falls, it is 0 in the last one."""
        if self.lr_decay_start is None:
            return self.lr
        left = (1 - at.frames / at.total) / max(1 - self.lr_decay_start, 1e-9)
        return self.lr * min(max(left, 0.0), 1.0)

    def state_dict(self) -> dict:
        return {"optimizer": self.optimizer.state_dict()["state"]}

    def load_state_dict(self, state: object) -> None:
        load_optimizer(self.optimizer, state.get("optimizer") if isinstance(state, dict) else None)

    def memory(self, frame: int) -> dict[str, int]:
        return self.learning_memory(self.policy.learning_bytes())

    def learning_memory(self, frame: int) -> dict[str, int]:
        size = min(self.minibatch_size, self.task.batch_frames)
        return {f"algo.minibatch_size={size}": size * frame}


def value_range(value: Tensor) -> str:
    """Return the least and the greatest number in a tensor, and how many of its values are not finite."""
    finite = value[value.isfinite()]
    text = f"{finite.min():.3g} to {finite.max():.3g}" if len(finite) else "no number"
    bad = value.numel() - len(finite)
    return text + f" ({bad} of {value.numel()} not finite)" * bool(bad)
