"""Epochs of shuffled minibatches over a batch: the gradient steps of most algorithms."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pickplace.algorithms.base import Algorithm, BatchPosition, Objective, Task, load_optimizer
from pickplace.common.capture import is_capturing
from pickplace.common.graphs import NO_COMPILE, Work
from pickplace.common.validate import number, or_null, whole_number
from pickplace.policies.base import Policy, as_collection_policy
from pickplace.runs.checkpoint import matching_state

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
MAX_RATE = 1.0  # Adam moves each weight by about the rate: with more no network stays finite for long


class MinibatchDescent(Algorithm):
    """Base class of algorithms that minimise a loss by Adam, in epochs of shuffled minibatches over each batch.

    A subclass sets :attr:`optimizer` by :meth:`use_parameters`.

    Args:
        policy: the policy that is trained.
        task: facts of the training.
        epochs: passes over each batch.
        minibatch_size: frames of each gradient step.
        lr: Adam's step size.
        lr_decay_start: share of the budget after which ``lr`` falls linearly to 0; None: constant. A resumed run with
            another ``lr``, ``lr_decay_start`` or budget begins this schedule anew, over the frames that are left.
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
        self.lr = number("algo.lr", lr, most=MAX_RATE)
        self.lr_decay_start = or_null(number, "algo.lr_decay_start", lr_decay_start, 0, 1)
        self.max_grad_norm = number("algo.max_grad_norm", max_grad_norm, 1e-9, MAX_WEIGHT)
        self.schedule: dict = {"settings": "", "since": 0}  # settings of the learning rate, and their first frame
        self._steps: dict[Objective, Work] = {}  # compiled gradient steps

    def acting_policy(self) -> TensorDictModuleBase:
        return as_collection_policy(self.policy)

    def use_parameters(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Make the optimizer of these parameters."""
        self.parameters = [*parameters]
        device, captured = self.parameters[0].device, self.task.compile.cudagraphs
        rate = torch.tensor(self.lr, device=device) if captured else self.lr  # a captured step reads it from there
        capturable = captured and device.type == "cuda"
        self.optimizer = torch.optim.Adam(self.parameters, lr=rate, eps=1e-5, fused=True, capturable=capturable)

    def descend(self, data: TensorDictBase, position: BatchPosition, objective: Objective) -> dict[str, float]:
        """Minimise an objective for ``epochs`` epochs of shuffled minibatches over frames ``[B]``.

        Returns:
            Mean diagnostics and the learning rate, ``train/...``.

        Raises:
            FloatingPointError: if the loss or its gradient is not finite; with captured steps after the batch, when the
                weights are not finite either.
        """
        rate = self.learning_rate(position)
        if position.frames_before == 0 and rate == 0 < self.lr:
            log.warning("total_frames=%d: the only batch has learning rate 0; nothing is learnt", position.total_frames)
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        step = self._compiled_step(objective)
        history: list[dict[str, Tensor]] = []  # diagnostics of each step
        for _ in range(self.epochs):
            for index in torch.randperm(len(data), device=data.device).split(self.minibatch_size):
                history.append(step(data[index]))
        sums = {name: float(sum(each[name] for each in history)) for name in history[0]}
        losses = [sums[name] for name in sums if name.startswith(("loss_", "grad_norm"))]
        if not all(map(math.isfinite, losses)):  # of captured steps, which do not look
            self._refuse_infinite(history[-1], data)
        return {f"train/{name}": total / len(history) for name, total in sums.items()} | {"train/lr": rate}

    def _compiled_step(self, objective: Objective) -> Callable[[TensorDictBase], dict[str, Tensor]]:
        """Return the function that makes a gradient step on a minibatch ``[B]`` for an objective."""
        if self.task.compile == NO_COMPILE:
            return partial(self._step, objective)
        if objective not in self._steps:

            def work(entries: dict[str, Tensor]) -> dict[str, Tensor]:
                part = TensorDict(entries, next(iter(entries.values())).shape[:1])
                return self._step(objective, part)

            self._steps[objective] = self.task.compile.network(work, "the gradient step")
        return lambda part: self._steps[objective](dict(part.items()))

    def _step(self, objective: Objective, part: TensorDictBase) -> dict[str, Tensor]:
        """Make a gradient step on a minibatch ``[B]``; return diagnostics."""
        total, losses = objective(part)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        if not is_capturing() and not torch.isfinite(norm + total.detach()):
            self._refuse_infinite(losses, part)
        self.optimizer.step()
        diagnostics = {name: losses[key].detach() for key, name in DIAGNOSTICS.items() if key in losses}
        return {**diagnostics, "grad_norm": norm}

    def _refuse_infinite(self, losses: Mapping[str, Tensor], part: TensorDictBase) -> NoReturn:
        parts = {key: value.detach() for key, value in losses.items() if key.startswith("loss_")}
        values = {**parts, **part}.items()
        ranges = "; ".join(f"{key} {value_range(value)}" for key, value in values if value.is_floating_point())
        raise FloatingPointError(f"the loss or its gradient is not finite: {ranges}; expected a smaller algo.lr.")

    def learning_rate(self, position: BatchPosition) -> float:
        """Return the learning rate of a batch. With ``lr_decay_start`` a new run reaches 0 in its last batch."""
        begun, frames, _, total = position
        falls = "" if self.lr_decay_start is None else f" lr_decay_start={self.lr_decay_start} total_frames={total}"
        before, now = self.schedule["settings"], f"lr={self.lr}{falls}"
        if before != now:
            self.schedule = {"settings": now, "since": begun if before else 0}
        if before and before != now:
            start = begun + (self.lr_decay_start or 0) * (total - begun)
            until = f", and falls to 0 from {start:,.0f} to {total:,} frames" * bool(falls)
            log.info("%s frames: the learning rate is now %g%s", f"{begun:,}", self.lr, until)
        if self.lr_decay_start is None:
            return self.lr
        since = self.schedule["since"]
        frames = begun if since else frames  # a run resumed with a new schedule learns in its last batch, too
        left = (1 - (frames - since) / max(total - since, 1)) / max(1 - self.lr_decay_start, 1e-9)
        return self.lr * min(max(left, 0.0), 1.0)

    def state_dict(self) -> dict:
        return {"optimizer": self.optimizer.state_dict()["state"], "schedule": self.schedule}

    def load_state_dict(self, state: object) -> None:
        given = state if isinstance(state, dict) else {}
        load_optimizer(self.optimizer, given.get("optimizer"))
        self.schedule = matching_state(given.get("schedule"), self.schedule, "learning rate")

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
