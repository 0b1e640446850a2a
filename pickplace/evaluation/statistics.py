"""Statistics of episodes: means, confidence intervals, paired differences."""

from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor

from pickplace.evaluation.play import Episodes
from pickplace.physics.outcome import Outcome
from pickplace.rules.state import Failure


def confidence95(values: Tensor, least: float = 0.0, most: float = 1.0) -> tuple[float, float]:
    """Return the 95% confidence interval of the mean, by Student's t, cut to the range of the values.

    Args:
        values: ``[E]``; with fewer than two the interval is the whole range.
        least, most: the range of a value.
    """
    if len(values) < 2:
        return least, most
    from scipy.stats import t  # takes a second to import, and only evaluation needs it

    mean, error = values.double().mean(), values.double().std() / len(values) ** 0.5
    margin = t.ppf(0.975, len(values) - 1) * error
    return max(float(mean - margin), least), min(float(mean + margin), most)


def summarise(result: Episodes) -> dict:
    """Return the figures of ``evaluation.json`` that come from the episodes."""
    low, high = confidence95(result.occupancy)
    reasons = Counter(Failure(code).name.lower() for code in result.failure.tolist())
    return {
        "occupancy": {
            "mean": float(result.occupancy.mean()),
            "ci95": [low, high],
            "min": float(result.occupancy.min()),
            "per_episode": result.occupancy.tolist(),
        },
        "items_placed": float(result.items_placed.double().mean()),
        "failures": dict(sorted(reasons.items())),
        "feasible_action_share": result.feasible_share,
    }


def summarise_physics(outcomes: Sequence[Outcome]) -> dict:
    """Return the figures of ``evaluation.json`` that come from carrying out the episodes in a physics engine."""
    occupancy = torch.tensor([outcome.occupancy for outcome in outcomes], dtype=torch.float64)
    done = torch.tensor([outcome.ending == "done" for outcome in outcomes])
    low, high = proportion95(int(done.sum()), len(done))
    return {
        "carried_out": {"mean": float(done.double().mean()), "ci95": [low, high]},
        "occupancy": {
            "mean": float(occupancy.mean()),
            "ci95": list(confidence95(occupancy)),
            "per_episode": occupancy.tolist(),
        },
        "endings": dict(sorted(Counter(outcome.ending for outcome in outcomes).items())),
        "drift": max(outcome.drift for outcome in outcomes),
        "cpu_seconds": sum(outcome.cpu_seconds for outcome in outcomes) / len(outcomes),
        "episodes": [outcome.facts() for outcome in outcomes],
    }


def proportion95(successes: int, count: int) -> tuple[float, float]:
    """Return the 95% confidence interval of a share, by Clopper and Pearson; it has a width at 0 and at 1, too."""
    from scipy.stats import beta

    low = beta.ppf(0.025, successes, count - successes + 1) if successes else 0.0
    high = beta.ppf(0.975, successes + 1, count - successes) if successes < count else 1.0
    return float(low), float(high)


def paired_difference(result: dict, other: dict) -> dict:
    """Return the mean occupancy of a result minus that of another one, episode by episode, with its 95% interval.

    Both have seen the same items, so that the difference does not depend on how hard the items are.

    Args:
        result, other: the contents of two ``evaluation.json``.
    """
    ours, theirs = (torch.tensor(r["occupancy"]["per_episode"], dtype=torch.float64) for r in (result, other))
    difference = ours - theirs
    return {
        "against": other["planner"],
        "mean": float(difference.mean()),
        "ci95": list(confidence95(difference, least=-1.0)),
    }
