"""Callbacks (config group ``callbacks``): a user's code at each batch, validation and change of level of a training."""

import json
from typing import Any

from pickplace.common.errors import sentence
from pickplace.common.validate import expect, number, or_null, refuse_if, whole_number
from pickplace.config.registry import build
from pickplace.evaluation.play import Episodes
from pickplace.runs.checkpoint import check_loads
from pickplace.runs.loggers import check_metrics


class Callback:
    """Base class; a callback overrides what it needs.

    ``trainer`` is the :class:`pickplace.training.trainer.Trainer`; ``trainer.end(reason)`` ends the training after the
    batch. ``metrics`` are those of the batch, by name; entries that a callback adds or changes are logged.

    Attributes:
        compares_validations: whether its state only compares validations. In a resumed run that validates by
            other settings (``evaluation``, ``planner``), it then begins anew.
    """

    compares_validations = False

    def on_batch(self, trainer: Any, metrics: dict[str, float]) -> None:
        """Called when a batch is learnt, before a validation that may follow."""

    def on_validation(self, trainer: Any, episodes: Episodes, metrics: dict[str, float]) -> None:
        """Called after a validation, whose means are in ``metrics["eval/..."]``, and before ``best`` is saved."""

    def on_level_change(self, trainer: Any, old: int, new: int) -> None:
        """Called when the curriculum has moved from one level to another, with their numbers."""

    def state_dict(self) -> dict:
        """Return the state that a checkpoint stores for a resume, as JSON: numbers, texts, lists and dicts."""
        return {}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a :meth:`state_dict`, which may come from a stranger's checkpoint."""


class EarlyStopping(Callback):
    """End the training at a validation occupancy, or when validations no longer improve.

    The logged reason says if the end may be luck. It may be if the validation that reached the occupancy has a 95%
    interval that begins below it, or if all validations since the best one are below the interval of the best one.

    Args:
        occupancy: mean validation occupancy, 0 to 1, that ends it; None: any.
        patience: validations in a row without a new best that end it; None: any number.
    """

    compares_validations = True

    def __init__(self, occupancy: float | None = None, patience: int | None = None):
        key = "callbacks.early_stopping."
        expect(
            (occupancy, patience) != (None, None), f"{key}occupancy", occupancy, f"a number, here or in {key}patience"
        )
        self.occupancy = or_null(number, f"{key}occupancy", occupancy, 0, 1)
        self.patience = or_null(whole_number, f"{key}patience", patience)
        # The best validation, those since, and the lower end of the best one's 95% interval.
        self.since: list[float] = []
        self.low = 0.0

    def on_validation(self, trainer, episodes, metrics):
        occupancy = metrics["eval/occupancy"]
        if not self.since or occupancy > self.since[0]:
            self.since, self.low = [], metrics["eval/ci95_low"]
        self.since.append(occupancy)
        best, *others = self.since
        if self.occupancy is not None and occupancy >= self.occupancy:
            reason, doubtful = f"the validation occupancy has reached {self.occupancy}", self.low < self.occupancy
        elif self.patience is not None and len(others) >= self.patience:
            reason, doubtful = f"{len(others)} validations without one above {best:.4f}", max(others) < self.low
        else:
            return
        luck = f"; perhaps luck: a single validation, whose 95% interval begins at {self.low:.4f}" if doubtful else ""
        trainer.end(f"early stopping: {reason}{luck}")

    def state_dict(self):
        return {"since": self.since, "low": self.low}

    def load_state_dict(self, state):
        self.since = [number("since", value, 0, 1) for value in state["since"]]
        self.low = number("low", state["low"], 0, 1)


def make_callbacks(cfg, states, validated_alike: bool = True) -> dict[str, Callback]:
    """Return the callbacks of a run by name, in the order of their config.

    Args:
        cfg: the config group ``callbacks``.
        states: their states by name, from a checkpoint; a callback without one begins anew.
        validated_alike: whether this run validates by the same settings as the run that saved the states.

    Raises:
        ValueError: naming the callback, for bad settings, a state that does not fit or one that cannot be saved.
    """
    callbacks = {name: build(f"callbacks.{name}", node) for name, node in cfg.items()}
    for name, callback in callbacks.items():
        expect(
            isinstance(callback, Callback),
            f"callbacks.{name}",
            callback,
            "the settings of a callback, with its _target_",
        )
        check_loads(callback, f"callbacks.{name}")
        try:
            if name in states and (validated_alike or not callback.compares_validations):
                callback.load_state_dict(states[name])
        except Exception as error:
            raise ValueError(f"callbacks.{name}: its state cannot be loaded ({sentence(error)}).") from error
    saved_states(callbacks)  # now, not after hours
    return callbacks


def saved_states(callbacks: dict[str, Callback]) -> dict[str, Any]:
    """Return the states of callbacks, as a checkpoint stores them.

    Raises:
        ValueError: naming the callback whose state is no JSON.
    """
    states = {}
    for name, callback in callbacks.items():
        try:
            states[name] = json.loads(json.dumps(callback.state_dict(), allow_nan=False))
        except Exception as error:
            raise ValueError(f"callbacks.{name}: its state cannot be saved ({sentence(error)}).") from error
    return states


def call(callbacks: dict[str, Callback], hook: str, trainer: Any, *arguments: Any) -> None:
    """Call a hook of each callback.

    Raises:
        ValueError: naming the callback, if it fails, or for a metric that it removes or that no logger can write.
    """
    metrics = arguments[-1] if isinstance(arguments[-1], dict) else {}
    for name, callback in callbacks.items():
        before, where = dict(metrics), f"callbacks.{name}.{hook}"
        try:
            getattr(callback, hook)(trainer, *arguments)
        except (AssertionError, AttributeError, LookupError, NameError, TypeError, ZeroDivisionError) as error:
            raise ValueError(f"{where} failed: {sentence(error)}") from error
        for key in before:
            refuse_if(
                key not in metrics, f"callbacks.{name}: it removes {key} from the metrics; expected changed values."
            )
        changed = {key: value for key, value in metrics.items() if key not in before or value is not before[key]}
        early = [key for key in changed if key.startswith("eval/") and hook != "on_validation"]
        refuse_if(early, f"{where}: it logs {', '.join(early)}; expected another name, eval/... is of validations.")
        check_metrics(f"callbacks.{name}", changed)
