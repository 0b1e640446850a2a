"""Hold the paper's claims (``claims.yaml``) against the results.

A comparison is decided where the interval of the difference lies on one side of its margin, with at least 20 episodes.
A loss of a policy whose training ended two or more cells below its tote's full height decides nothing.
"""

from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import hypot
from pathlib import Path

import torch
import yaml

from pickplace.evaluation.result import confidence95

FEW = 20  # episodes below which nothing is decided


@dataclass(frozen=True)
class Comparison:
    """One comparison; ``claims.yaml`` says what its attributes mean."""

    a: str
    b: tuple[str, ...]
    margin: float = 0.0
    trained: bool = False
    below: bool = False
    wide: "Comparison | None" = None


@dataclass(frozen=True)
class Finding:
    """The verdict on a comparison, and what it rests on."""

    verdict: str  # yes, no, undecided, attempted (a side could not be computed) or missing
    mean: float = 0.0  # the difference, and its interval
    low: float = 0.0
    high: float = 0.0
    seeds: tuple[int, ...] = ()  # of each side that was trained
    sound: bool = True  # enough episodes, and trainings to the end


def read() -> list[dict]:
    """Return the claims, the comparisons of each policy expanded."""
    claims = yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text())
    for claim in claims:
        for policy, entries in claim["policies"].items():
            claim["policies"][policy] = [comparison for entry in entries for comparison in expand(entry)]
    return claims


def expand(entry: dict) -> list[Comparison]:
    """Return the comparisons of an entry of ``claims.yaml``."""
    settings = {key: entry[key] for key in ("margin", "trained", "below") if key in entry}

    def at(r, tote):
        return entry["a"].format(R=r, tote=tote), tuple(name.format(R=r, tote=tote) for name in entry["b"])

    axes = product(*(entry.get(axis, [None]) for axis in ("R", "tote", "wide")))
    return [Comparison(*at(r, tote), **settings, wide=wide and Comparison(*at(r, wide))) for r, tote, wide in axes]


def seeds_of(name: str, known: Container[str]) -> dict[int | None, str]:
    """Return the known cells that a name stands for, by training seed (None without ``s*``)."""
    names = {seed: name.replace("s*", f"s{seed}") for seed in range(3)} if "s*" in name else {None: name}
    return {seed: cell for seed, cell in names.items() if cell in known}


def difference(a: str, b: str, episodes: Mapping[str, Sequence[float]]) -> dict:
    """Return a row of ``differences.csv``: the occupancy of ``a`` minus that of ``b`` in the same episodes.

    The interval is the 95% interval over episodes of the mean over seeds, widened to the range of the seeds. Seeds of
    one method are paired with themselves, seeds of two methods each with each.
    ``episodes`` has the occupancy of each episode, by cell.
    """
    if b[0].isdigit():
        episodes = {**episodes, b: [float(b)] * 10_000}
    ours, theirs = seeds_of(a, episodes), seeds_of(b, episodes)
    same = a.partition("-")[0] == b.partition("-")[0]
    pairs = [(ours[i], theirs[j]) for i, j in product(ours, theirs) if i == j or not same]
    count = min(len(episodes[cell]) for pair in pairs for cell in pair)
    gaps = torch.tensor([[episodes[cell][:count] for cell in pair] for pair in pairs], dtype=torch.float64)
    gaps = gaps[:, 0] - gaps[:, 1]  # [pairs, episodes]
    low, high = confidence95(gaps.mean(0), least=-1.0)
    row = {"a": a, "b": b, "mean": float(gaps.mean()), "episodes": count}
    row |= {"low": min(low, float(gaps.mean(1).min())), "high": max(high, float(gaps.mean(1).max()))}
    return row | {"seeds_a": len({x for x, _ in pairs}), "seeds_b": len({y for _, y in pairs}) if "s*" in b else 0}


def learning_difference(a: str, b: str, curves: Collection[dict]) -> dict:
    """Return the same for validations of two trainings after as many frames; the interval is the range of the seeds."""
    runs: dict[str, dict] = {}
    for point in curves:
        runs.setdefault(point["training"], {})[point["frames"]] = point["occupancy"]
    ours, theirs = ([runs[cell] for cell in seeds_of(name, runs).values()] for name in (a, b))
    frames = min(max(run) for run in ours + theirs)
    ours, theirs = ([run[max(f for f in run if f <= frames)] for run in part] for part in (ours, theirs))
    mean = sum(ours) / len(ours) - sum(theirs) / len(theirs)
    low, high = min(ours) - max(theirs), max(ours) - min(theirs)
    return {"a": a, "b": b, "mean": mean, "low": low, "high": high, "seeds_a": len(ours), "seeds_b": len(theirs)}


def measure(
    results: dict, differences: dict, curves: list[dict], episodes: Mapping[str, Sequence[float]]
) -> list[dict]:
    """Return the rows that ``differences.csv`` lacks, as far as learning curves and episodes allow."""
    rows, trainings = {}, {point["training"] for point in curves}
    comparisons = [c for claim in read() for part in claim["policies"].values() for c in part]
    for comparison in comparisons + [c.wide for c in comparisons if c.wide]:
        a, b = comparison.a, rival(comparison, results)
        if b is None or (a, b) in differences:
            continue
        if seeds_of(a, trainings) and seeds_of(b, trainings):
            rows[a, b] = learning_difference(a, b, curves)
        cells = [cell for name in (a, b) for cell in seeds_of(name, results).values() if "mean" in results[cell]]
        there = {cell: episodes[cell] for cell in cells if cell in episodes}
        if len(there) == len(cells) and seeds_of(a, there) and (seeds_of(b, there) or b[0].isdigit()):
            rows[a, b] = difference(a, b, there)
    return list(rows.values())


def rival(comparison: Comparison, results: Mapping[str, dict]) -> str | None:
    """Return the best ``b`` of a comparison; None while one of several has no row."""
    means = {}
    for name in comparison.b if len(comparison.b) > 1 else ():
        rows = [results[cell] for cell in seeds_of(name, results).values()]
        if not rows:
            return None
        there = [row["mean"] for row in rows if "mean" in row]
        means |= {name: sum(there) / len(there)} if there else {}
    return max(means, key=means.__getitem__, default=comparison.b[0])


def in_vain(name: str, results: Mapping[str, dict]) -> bool:
    """Return whether every cell of a name was attempted only."""
    cells = seeds_of(name, results).values()
    return bool(cells) and not any("mean" in results[cell] for cell in cells)


def untrained(name: str, results: Mapping[str, dict]) -> bool:
    """Return whether a seed's training ended two or more cells below its tote's full height."""
    rows = [results[cell] for cell in seeds_of(name, results).values()]
    return any(row["height_reached"] <= row["training_tote_height"] - 2 for row in rows if "height_reached" in row)


def judge(comparison: Comparison, results: Mapping[str, dict], differences: Mapping[tuple[str, str], dict]) -> Finding:
    """Return the verdict on a comparison, from the rows of two tables by key."""
    a, b, margin = comparison.a, rival(comparison, results), comparison.margin
    row = differences.get((a, b))
    if row is None:
        return Finding("attempted" if in_vain(a, results) or (b and in_vain(b, results)) else "missing")
    above = True if row["low"] > margin else False if row["high"] < margin else None
    must = {True: comparison.b, False: (a,), None: ()}[above] + ((a, b) if comparison.trained else ())
    sound = row.get("episodes", FEW) >= FEW and not any(untrained(name, results) for name in must)
    word = "undecided" if above is None or not sound else "yes" if above != comparison.below else "no"
    seeds = tuple(count for count in (row["seeds_a"], row["seeds_b"]) if count)
    found = Finding(word, row["mean"], row["low"], row["high"], seeds, sound)
    if comparison.wide is None:
        return found
    wide = judge(comparison.wide, results, differences)
    if wide.verdict in ("attempted", "missing"):
        return wide
    mean = found.mean - wide.mean  # of other episodes: the intervals add in quadrature
    low = mean - hypot(found.mean - found.low, wide.high - wide.mean)
    high = mean + hypot(found.high - found.mean, wide.mean - wide.low)
    sound = found.sound and wide.sound
    word = "yes" if sound and low > 0 and found.low > 0 else "no" if sound and high < 0 else "undecided"
    return Finding(word, mean, low, high, found.seeds + wide.seeds, sound)
