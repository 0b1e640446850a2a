"""Metrics of a batch and of a validation, and the intervals at which something happens."""

from tensordict import TensorDictBase

from pickplace.evaluation.play import Episodes
from pickplace.evaluation.result import confidence95
from pickplace.rules.state import Failure


def episode_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Mean reward, and of the episodes that ended in the batch: number, mean occupancy and shares of failures."""
    done = batch["next", "done"]
    metrics = {"train/reward": batch["next", "reward"].mean().item(), "train/episodes": int(done.sum())}
    if done.any():
        metrics["train/occupancy"] = batch["next", "occupancy"][done].mean().item()
        reasons = batch["next", "failure"][done]
        for failure in Failure:
            metrics[f"train/failure_{failure.name.lower()}"] = (reasons == failure).float().mean().item()
    return metrics


def validation_metrics(episodes: Episodes) -> dict[str, float]:
    """Mean occupancy of a validation and its 95% interval."""
    low, high = confidence95(episodes.occupancy)
    return {"occupancy": float(episodes.occupancy.mean()), "ci95_low": low, "ci95_high": high}


def has_passed(before: int, now: int, interval: int) -> bool:
    """Return whether a multiple of ``interval`` lies in ``(before, now]``; it works for any batch size."""
    return before // interval != now // interval
