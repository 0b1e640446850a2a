"""The paper's claims, each held against our figures, for each network: borne out, not, in part, or not known yet.

A claim is a list of comparisons, of all training seeds that there are. One is decided where the 95% interval of a
paired difference, of at least twenty episodes, lies on one side of a margin; not where it would be decided by a network
that was not trained up to its tote's height, or one cell less.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import product
from math import hypot

import torch
from figures import FEW, TOTES, label, one_seed

from pickplace.evaluate import confidence95

ROTATIONS = (1, 2, 3, 4)
ATTEMPTED = "attempted"  # in place of a comparison one side of which could not be computed


@dataclass(frozen=True)
class Comparison:
    """One difference.

    Attributes:
        text: what was compared.
        verdict: whether it bears the claim out; None: not to be told.
        difference: mean, and its 95% interval.
        remark: what to know of it.
        sound: with episodes and trainings enough to decide.
    """

    text: str
    verdict: bool | None
    difference: tuple[float, float, float]
    remark: str = ""
    sound: bool = True

    def __str__(self):
        centre, low, high = self.difference
        return f"{self.text} {centre:+.4f} ({low:+.4f} to {high:+.4f})"


@dataclass
class Group:
    """All comparisons of a claim for one network, ``ATTEMPTED``, or None for what is not yet; and why, if it fails."""

    name: str
    comparisons: list[Comparison | str | None] = field(default_factory=list)
    why: str = ""

    @property
    def found(self) -> list[Comparison]:
        return [comparison for comparison in self.comparisons if isinstance(comparison, Comparison)]

    def word(self) -> str:
        """The verdict, with the number of comparisons behind it where it is not all of them."""
        verdicts = [comparison.verdict for comparison in self.found]
        yes, no, in_vain = verdicts.count(True), verdicts.count(False), self.comparisons.count(ATTEMPTED)
        every = len(self.comparisons) - in_vain
        tail = f"; {in_vain} attempted in vain" if in_vain else ""
        if not verdicts:
            return "not known yet" if None in self.comparisons else ATTEMPTED
        if not yes and not no:
            return "undecided"
        if yes == every:
            return f"yes{tail}"
        if yes and no:
            return f"in part ({yes} of {every}, against {no}){tail}"
        if yes:
            sure = f"so far ({yes} of {every})" if None in self.comparisons else f"({yes} of {every}, not all sure)"
            return f"yes {sure}{tail}"
        return f"no ({no} of {every}){tail}"

    def reasons(self) -> list[str]:
        why = [self.why] if self.why and any(comparison.verdict is False for comparison in self.found) else []
        return list(dict.fromkeys([*why, *(comparison.remark for comparison in self.found if comparison.remark)]))

    def evidence(self) -> str:
        """Every comparison; of many the least and the greatest first."""
        if not self.found:
            return ""
        every = "; ".join(map(str, self.found))
        if len(self.found) > 4:
            low, *_, high = sorted(self.found, key=lambda comparison: comparison.difference[0])
            every = f"from {low} up to {high}<details><summary>all {len(self.found)}</summary>{every}</details>"
        return f"{called(self.name)}: {every}"


def called(name: str) -> str:
    """A method, or that of a cell, as tables call it."""
    return f"*{label(name.partition('-')[0])}*"


def mean(results, name) -> float | None:
    """Mean occupancy of a cell, None where there is none yet."""
    return results[name]["occupancy"]["mean"] if "occupancy" in results.get(name, {}) else None


def decided(low: float, high: float, margin: float) -> bool | None:
    """Above the margin, below it, or not to be told."""
    return True if low > margin else False if high < margin else None


def seeds(results, name: str) -> list[str]:
    """A cell, named by training seed 0, and those of the other seeds that there are."""
    names = [name, *(name.replace("-s0-", f"-s{seed}-") for seed in (1, 2) if "-s0-" in name)]
    return [other for other in names if "occupancy" in results.get(other, {})]


def pairs_of_seeds(results, ours: str, theirs: str) -> list[tuple[str, str]]:
    """The cells to compare: each policy with itself, or each of one method with each of another."""
    pairs = list(product(seeds(results, ours), seeds(results, theirs)))
    if ours.partition("-")[0] != theirs.partition("-")[0]:
        return pairs
    number = re.compile(r"-s(\d)-")
    return [(a, b) for a, b in pairs if number.findall(a) == number.findall(b)]


def untrained(results, name: str, short: int = 2) -> str:
    """What to say of a cell's policy, of any seed, that fell so many cells short of its tote's height in training."""
    for cell in seeds(results, name):
        training = results.get(results[cell].get("training"), {})
        levels = training.get("curve", {}).get("level")
        word = next((word for word in training.get("command", "").split() if word.startswith("env.tote_size=")), "5]")
        full = int(word.rstrip("]").rpartition(",")[2])
        if levels and levels[-1] <= full - short:
            return f"{called(name)} came to a tote height of {levels[-1]} of {full} only"
    return ""


def compare(
    results, text: str, ours: str, theirs: str, margin: float = 0.0, learned: Iterable[str] = ()
) -> Comparison | str | None:
    """Is one cell above another by more than a margin? ``ATTEMPTED`` or None where one of them is not there.

    With several training seeds the interval is that over episodes, of each the mean over seeds, widened to the range
    of the seeds.

    Args:
        results: every result.
        text: what to call the comparison.
        ours: a cell.
        theirs: the cell that it is held against.
        margin: of mean occupancy.
        learned: cells whose policy must have been trained to the end, or nothing is decided.
    """
    if any("attempted" in results.get(name, {}) for name in (ours, theirs)):
        return ATTEMPTED
    if not (pairs := pairs_of_seeds(results, ours, theirs)):
        return None
    mine, others = (len(set(side)) for side in zip(*pairs, strict=True))
    if mine > 1 or others > 1:
        text += f", {mine} seeds" if mine == others else f", {mine} seed{'s' * (mine > 1)} against {others}"
    played = [[results[name]["occupancy"]["per_episode"] for name in pair] for pair in pairs]
    episodes = min(len(part) for pair in played for part in pair)
    gaps = torch.tensor([[part[:episodes] for part in pair] for pair in played], dtype=torch.float64)
    gaps = gaps[:, 0] - gaps[:, 1]  # [pairs, episodes]
    low, high = confidence95(gaps.mean(0), least=-1.0) if episodes > 1 else (-1.0, 1.0)
    gap = (float(gaps.mean()), min(low, float(gaps.mean(1).min())), max(high, float(gaps.mean(1).max())))
    if episodes < FEW:
        return Comparison(f"{text} ({episodes} episodes)", None, gap, sound=False)
    short = [remark for name in learned if (remark := untrained(results, name))]
    remark = next(filter(None, [*short, *(untrained(results, name, short=1) for name in learned)]), "")
    return Comparison(text, None if short else decided(gap[1], gap[2], margin), gap, remark, sound=not short)


def unless_untrained(comparison, results, name: str):
    """A comparison; if it fails, and the policy of this cell was not trained to the end, it is not decided."""
    if isinstance(comparison, Comparison) and not comparison.verdict and (remark := untrained(results, name)):
        return replace(comparison, verdict=None, remark=remark, sound=False)
    return comparison


JOINT = ("fcn_grasp_unmasked", "fcn4d")
TEN = "-R{}-s0-{}-K10"  # after the name of a network
INDIVIDUAL = ("individual_rl-R{}-s0-{}-K10", "individual_heuristic-R{}-{}")
EVERY_CELL = ("individual_heuristic_cells-R{}-{}",)
SAME_NETWORK = (  # joint planning, and individual planning with its network
    ("fcn_grasp-R{}-s0-{}-Kall", "individual_grasp-R{}-s0-{}-Kall"),
    ("fcn_grasp_unmasked-R{}-s0-{}-K10", "individual_grasp_unmasked-R{}-s0-{}-K10"),
)


def rotations_of(joint: str) -> tuple[int, ...]:
    return (3, 4) if joint.startswith("fcn4d") else ROTATIONS


def best_of(results, names) -> str | None:
    """The cell with the greatest mean; None until all are there, or have been tried in vain."""
    if not all("occupancy" in results.get(name, {}) or "attempted" in results.get(name, {}) for name in names):
        return None
    there = {name: mean(results, name) for name in names if mean(results, name) is not None}
    return max(there, key=there.get, default=None)


def against(results, joint: str, individual) -> list[Comparison | str | None]:
    """A joint network's cells against the best of these methods', at every tote and R; each has had an hour at most."""
    found = []
    for tote in TOTES:
        for r in rotations_of(joint):
            ours = one_seed(results, joint.format(r, tote))
            best = best_of(results, [one_seed(results, name.format(r, tote)) for name in individual])
            if best is None:
                found.append(None)
                continue
            comparison = compare(results, f"{tote} R={r}, minus {called(best)}", ours, best)
            if isinstance(comparison, Comparison):  # to be said, though it has had the same hour
                comparison = replace(comparison, remark=untrained(results, best))
            found.append(unless_untrained(comparison, results, ours))
    return found


def joint_beats_individual(results) -> list[Group]:
    """K=10, against the better of the paper's two individual methods."""
    return [Group(joint, against(results, joint + TEN, INDIVIDUAL)) for joint in JOINT]


#: Why some wide totes stand against fcn_grasp without a mask.
WEAKEST = "30x30 totes are met by one seed, at R=3 the weakest of three, whose 10 candidates all fail in some episodes"


def joint_beats_every_cell(results) -> list[Group]:
    why = f"the more rotations, the more trying every cell makes up for the pick that was fixed beforehand; {WEAKEST}"
    return [Group(joint, against(results, joint + TEN, EVERY_CELL), why) for joint in JOINT]


def joint_beats_the_same_network(results) -> list[Group]:
    """The pick by heuristic, and all else as for the joint policy."""
    why = f"with four rotations the heuristic's pick reaches every cell of the tote, too; {WEAKEST}"
    return [Group(joint.partition("-")[0], against(results, joint, (single,)), why) for joint, single in SAME_NETWORK]


def most_on_small_totes(results) -> list[Group]:
    return [gains_on_small_totes(results, JOINT[0] + TEN, INDIVIDUAL)]


def most_on_small_totes_with_the_same_network(results) -> list[Group]:
    return [gains_on_small_totes(results, joint, (single,)) for joint, single in SAME_NETWORK]


def gains_on_small_totes(results, joint: str, individual) -> Group:
    """What joint planning gains at 6x6 minus what it gains on wider totes of the same height."""
    pairs = [(small, wide) for small in TOTES[:2] for wide in TOTES[2:]]
    pairs = [(small, wide) for small, wide in pairs if small.rpartition("x")[2] == wide.rpartition("x")[2]]
    compared = against(results, joint, individual)
    gains = dict(zip([(t, r) for t in TOTES for r in ROTATIONS], compared, strict=True))
    found = []
    for small, wide in pairs:
        for r in ROTATIONS:
            ours, theirs = gains[small, r], gains[wide, r]
            if not (isinstance(ours, Comparison) and isinstance(theirs, Comparison)):
                found.append(ATTEMPTED if ATTEMPTED in (ours, theirs) else None)
                continue
            (a, low, high), (b, lower, higher) = ours.difference, theirs.difference
            half = hypot((high - low) / 2, (higher - lower) / 2)  # other episodes: the two do not pair
            more = (a - b, a - b - half, a - b + half)
            sound, verdict = ours.sound and theirs.sound, decided(*more[1:], 0.0)
            verdict = None if not sound or (verdict and low <= 0) else verdict  # a smaller loss is no gain
            remark = ours.remark or theirs.remark
            found.append(Comparison(f"R={r}, gain at {small} minus at {wide}", verdict, more, remark, sound))
    why = "individual policies without a mask, trained at height 5, pack totes of height 10 badly at R=1, wide ones too"
    return Group(joint.partition("-")[0], found, why)


def k_settles(results) -> list[Group]:
    """K=10 is better than K=1, and K=50 by less than a hundredth better than K=10."""
    groups = []
    for joint in JOINT:
        names = {k: f"{joint}-R3-s0-6x6x5-K{k}" for k in (1, 10, 50)}
        rise = compare(results, "K=10 minus K=1", names[10], names[1], learned=[names[10]])
        more = compare(results, "K=50 minus K=10", names[50], names[10], margin=0.01, learned=[names[10]])
        if isinstance(more, Comparison) and more.verdict is not None:
            more = replace(more, verdict=not more.verdict)
        groups.append(
            Group(joint, [rise, more], "a policy that is not sure of what is feasible gains from more than ten")
        )
    return groups


SIZES = (("fcn_grasp", "all"), ("fcn_grasp_unmasked", 10), ("fcn4d", 10), ("fcn4d_warm", "all"))


def no_loss_with_size(results) -> list[Group]:
    """No tote but 6x6x10 is packed worse than 6x6x5 by more than a hundredth."""
    groups = []
    for method, k in SIZES:
        found = []
        for tote in TOTES[2:]:
            name = one_seed(results, f"{method}-R4-s0-{tote}-K{k}")
            small = name.replace(tote, "6x6x5")  # of the same training
            found.append(compare(results, f"{tote} minus 6x6x5", name, small, -0.01, learned=[small]))
        groups.append(Group(method, found))
    return groups


def high_tote_is_harder(results) -> list[Group]:
    why = "where nearly every layer is filled, what is lost at the rim weighs half as much in a tote twice as high"
    groups = []
    for method, k in SIZES:
        low, high = (f"{method}-R4-s0-{tote}-K{k}" for tote in ("6x6x5", "6x6x10"))
        groups.append(Group(method, [compare(results, "6x6x5 minus 6x6x10", low, high, learned=[low])], why))
    return groups


def typical_learns_poorly(results) -> list[Group]:
    """After as many frames, every seed of it is below every seed of fcn4d by more than a twentieth.

    The figures are validations while training, of few episodes: the range of the seeds stands for an interval.
    """
    curves = [
        [results.get(name.format(seed), {}).get("curve") for seed in range(3)]
        for name in ("typical-6x6x5-s{}", "fcn4d-R4-s{}")
    ]
    there = [[curve for curve in part if curve and curve["validation_frames"]] for part in curves]
    if not all(there):
        return [Group("typical", [None])]
    frames = min(curve["validation_frames"][-1] for part in there for curve in part)
    typical, paper = ([at(curve, frames) for curve in part] for part in there)
    low, high = min(paper) - max(typical), max(paper) - min(typical)
    middle = sum(paper) / len(paper) - sum(typical) / len(typical)
    text = f"fcn4d minus it after {frames:,} frames, {len(paper)} and {len(typical)} of 3 seeds (least, greatest)"
    learned = min(paper) > 0.2  # about what random feasible choices fill; else there is nothing to be worse than
    verdict = decided(low, high, 0.05) if learned and len(typical) == len(paper) == 3 else None
    return [Group("typical", [Comparison(text, verdict, (middle, low, high))])]


def at(curve: dict, frames: int) -> float:
    """The last validation until then."""
    pairs = zip(curve["validation_frames"], curve["validation_occupancy"], strict=True)
    return [value for when, value in pairs if when <= frames][-1]


def clipping_helps(results) -> list[Group]:
    """Where the tote is higher than the clip: trained low with it, against trained at the size itself without."""
    names = [f"{method}-R4-s0-6x6x10-Kall" for method in ("fcn_grasp", "fcn_grasp_noclip")]
    grasp = [compare(results, "6x6x10, clipped minus not", *names, learned=names)]
    paper = []
    for tote in ("6x6x10", "10x10x10", "30x30x10"):
        names = [one_seed(results, f"{method}-R4-s0-{tote}-K1") for method in ("fcn4d", "fcn4d_noclip")]
        paper.append(compare(results, f"{tote}, clipped minus not", *names, learned=reversed(names)))
    return [Group("fcn_grasp", grasp), Group("fcn4d", paper)]


def mcts_far_behind(results) -> list[Group]:
    """By more than a tenth of the tote, behind a policy at K=1."""
    groups = []
    for joint in JOINT:
        found = []
        for tote in TOTES:
            ours, tree = one_seed(results, f"{joint}-R4-s0-{tote}-K1"), f"mcts-R4-{tote}-mask_false"
            comparison = compare(results, f"{tote}, minus mcts", ours, tree, margin=0.1)
            found.append(unless_untrained(comparison, results, ours))
        groups.append(Group(joint, found))
    return groups


def large_totes_work(results) -> list[Group]:
    """At least 0.8 of a 30x30 tote."""
    groups = []
    for method, k in SIZES:
        found = []
        for tote in TOTES[4:]:
            name = one_seed(results, f"{method}-R4-s0-{tote}-K{k}")
            if mean(results, name) is None:
                found.append(ATTEMPTED if name in results else None)
                continue
            low, high = results[name]["occupancy"]["ci95"]
            gap = (mean(results, name) - 0.8, low - 0.8, high - 0.8)
            few = results[name]["episodes"] < FEW
            text = f"{tote} minus 0.8" + f" ({results[name]['episodes']} episodes)" * few
            comparison = Comparison(text, None if few else decided(gap[1], gap[2], 0.0), gap, sound=not few)
            found.append(unless_untrained(comparison, results, name))
        groups.append(Group(method, found))
    return groups


HOW = f"""For each network, with all training seeds that met a tote. The interval is that over episodes, each the mean
over seeds, widened to the range of the seeds: between two methods, of each seed of the one against each of the other.
*Yes* and *no* need an interval that lies on one side, {FEW} episodes, and a training that came up to its tote's height,
or one cell less; numbers count comparisons.
"""

#: What the paper says, and what holds it against our figures.
CLAIMS = [
    ("Joint planning beats individual planning (K=10)", joint_beats_individual),
    (
        "beyond the paper: joint planning beats individual planning with the same network and training",
        joint_beats_the_same_network,
    ),
    ("beyond the paper: joint planning also beats the heuristic that tries every cell", joint_beats_every_cell),
    ("most on small totes", most_on_small_totes),
    ("beyond the paper: that gain is the largest on small totes", most_on_small_totes_with_the_same_network),
    ("K settles near 10", k_settles),
    ("No loss as totes grow", no_loss_with_size),
    ("6x6x10 is packed less well than 6x6x5", high_tote_is_harder),
    ("A fully connected (typical) network learns poorly", typical_learns_poorly),
    ("Depth clipping helps", clipping_helps),
    ("MCTS is far behind (K=1)", mcts_far_behind),
    ("30x30 totes are packed well by a policy trained at 6x6x5", large_totes_work),
]


def verdict(groups: list[Group]) -> str:
    """One word where all networks agree, else one for each."""
    words = {called(group.name): group.word() for group in groups}
    if len(set(words.values())) == 1:
        return next(iter(words.values()))
    return "<br>".join(f"{name}: {word}" for name, word in words.items())


def reasons(groups: list[Group]) -> str:
    """Why networks do not bear a claim out, and what to know of those that do."""
    return "; ".join(dict.fromkeys(reason for group in groups for reason in group.reasons()))


def table(results) -> list[str]:
    """Lines of a table, claim, verdict and why; and of a list with the differences behind each."""
    checked = [(claim, check(results)) for claim, check in CLAIMS]
    lines = ["| the paper's claim | our figures bear it out | why not, and what to know |", "|---|---|---|"]
    lines += [f"| {claim} | {verdict(groups)} | {reasons(groups)} |" for claim, groups in checked]
    lines += ["", "The differences of occupancy behind each verdict, and their 95% intervals:", ""]
    for claim, groups in checked:
        lines += [f"- **{claim}**", *(f"  - {evidence}" for group in groups if (evidence := group.evidence()))]
    return lines
