"""The paper's claims, each held against our figures, for each network: how many comparisons bear it out, how many not.

A claim is a list of comparisons, of all training seeds that there are (``s*`` in the names of cells). One is decided
where the interval of a paired difference, of at least twenty episodes, lies on one side of a margin; not where it is
lost by a network that was not trained up to its tote's height, or one cell less.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import hypot

import torch
from figures import FEW, TOTES, label, pooled

from pickplace.evaluation.evaluate import confidence95

ROTATIONS = (1, 2, 3, 4)
ATTEMPTED = "attempted"  # in place of a comparison one side of which could not be computed
VERDICTS = {True: "yes", False: "no", None: "undecided"}
SEED = re.compile(r"-s(\d)-")


@dataclass(frozen=True)
class Comparison:
    """One difference.

    Attributes:
        text: what was compared.
        verdict: whether it bears the claim out; None: not to be told.
        difference: mean, and its interval.
        remark: what to know of it.
        sound: with episodes and trainings enough to decide.
        single: it rests on one training seed, of one side at least.
    """

    text: str
    verdict: bool | None
    difference: tuple[float, float, float]
    remark: str = ""
    sound: bool = True
    single: bool = False

    def __str__(self):
        centre, low, high = self.difference
        return f"{self.text} {centre:+.4f} ({low:+.4f} to {high:+.4f})"


@dataclass
class Group:
    """All comparisons of a claim for one network, ``ATTEMPTED``, or None for what is not yet.

    Attributes:
        why: the reason if one fails.
        note: what to know in any case.
    """

    name: str
    comparisons: list[Comparison | str | None] = field(default_factory=list)
    why: str = ""
    note: str = ""

    @property
    def found(self) -> list[Comparison]:
        return [comparison for comparison in self.comparisons if isinstance(comparison, Comparison)]

    def word(self) -> str:
        """The verdict where all comparisons have the same, else how many have which."""
        if not self.found:
            return "not known yet" if None in self.comparisons else ATTEMPTED
        counts = []
        for verdict, word in VERDICTS.items():
            those = [comparison for comparison in self.found if comparison.verdict is verdict]
            single = sum(comparison.single for comparison in those) if verdict is not None else 0
            alone = f" ({single} by one seed)" if single and len(those) > 1 else " (by one seed)" if single else ""
            if len(those) == len(self.comparisons):
                return word + f", all {len(those)}" * (len(those) > 1 and verdict is not None) + alone
            counts += [f"{len(those)} {word}{alone}"] if those else []
        for state, word in ((None, "not known yet"), (ATTEMPTED, "attempted in vain")):
            counts += [f"{number} {word}"] if (number := self.comparisons.count(state)) else []
        return ", ".join(counts)

    def reasons(self) -> list[str]:
        why = [self.why] if any(comparison.verdict is False for comparison in self.found) else []
        return list(dict.fromkeys(filter(None, [*why, self.note, *(comparison.remark for comparison in self.found)])))

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


def mean(results, name: str) -> float | None:
    """Mean occupancy of a cell, over its seeds; None where there is none yet."""
    found = pooled(results, name)
    return found["occupancy"]["mean"] if found and "occupancy" in found else None


def in_vain(results, name: str) -> bool:
    """Has a cell been attempted, and none of its seeds been computed?"""
    return "attempted" in (pooled(results, name) or {})


def decided(low: float, high: float, margin: float) -> bool | None:
    """Above the margin, below it, or not to be told."""
    return True if low > margin else False if high < margin else None


def seeds(results, name: str) -> list[str]:
    """The cells that there are of a name, of all training seeds."""
    names = dict.fromkeys(name.replace("s*", f"s{seed}") for seed in range(3))
    return [other for other in names if "occupancy" in results.get(other, {})]


def pairs_of_seeds(results, ours: str, theirs: str) -> list[tuple[str, str]]:
    """The cells to compare: each policy with itself, or each of one method with each of another."""
    pairs = list(product(seeds(results, ours), seeds(results, theirs)))
    if ours.partition("-")[0] != theirs.partition("-")[0]:
        return pairs
    return [(a, b) for a, b in pairs if SEED.findall(a) == SEED.findall(b)]


def how_many_seeds(pairs: list[tuple[str, str]]) -> tuple[str, bool]:
    """How to tell the training seeds behind pairs of cells, and whether a side that was trained has but one."""
    ours, theirs = (dict.fromkeys(side) for side in zip(*pairs, strict=True))
    counts = [len(side) for side in (ours, theirs) if SEED.search(next(iter(side)))]
    if not counts:
        return "", False
    words = ["one seed" if count == 1 else f"{count} seeds" for count in counts]
    if len(set(words)) == 1:
        return f", {words[0]}", counts[0] == 1
    return f", {' against '.join(words)}", 1 in counts


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
    results,
    text: str,
    ours: str,
    theirs: str,
    margin: float = 0.0,
    learned: Sequence[str] = (),
    rivals: Sequence[str] = (),
) -> Comparison | str | None:
    """Is one cell above another by more than a margin? ``ATTEMPTED`` or None where one of them is not there.

    With several training seeds the interval is that over episodes, of each the mean over seeds, widened to the range
    of the seeds. Who was not trained to the end loses nothing by it: that is not decided.

    Args:
        results: every result.
        text: what to call the comparison.
        ours: a cell.
        theirs: the cell that it is held against.
        margin: of mean occupancy.
        learned: cells whose policy must have been trained to the end, or nothing is decided.
        rivals: cells that lose together with ``theirs``, which is the best of them.
    """
    if in_vain(results, ours) or in_vain(results, theirs):
        return ATTEMPTED
    if not (pairs := pairs_of_seeds(results, ours, theirs)):
        return None
    told, single = how_many_seeds(pairs)
    text += told
    played = [[results[name]["occupancy"]["per_episode"] for name in pair] for pair in pairs]
    episodes = min(len(part) for pair in played for part in pair)
    gaps = torch.tensor([[part[:episodes] for part in pair] for pair in played], dtype=torch.float64)
    gaps = gaps[:, 0] - gaps[:, 1]  # [pairs, episodes]
    low, high = confidence95(gaps.mean(0), least=-1.0) if episodes > 1 else (-1.0, 1.0)
    gap = (float(gaps.mean()), min(low, float(gaps.mean(1).min())), max(high, float(gaps.mean(1).max())))
    if episodes < FEW:
        return Comparison(f"{text} ({episodes} episodes)", None, gap, sound=False, single=single)
    verdict = decided(gap[1], gap[2], margin)
    losers = {True: [theirs, *rivals], False: [ours], None: [ours, theirs]}[verdict]
    short = [remark for name in (*learned, *losers) if (remark := untrained(results, name))]
    remark = next(filter(None, [*short, *(untrained(results, name, short=1) for name in learned)]), "")
    return Comparison(text, None if short else verdict, gap, remark, sound=not short, single=single)


JOINT = ("fcn_grasp_unmasked", "fcn4d")
TEN = "-R{}-s*-{}-K10"  # after the name of a network
INDIVIDUAL = ("individual_rl-R{}-s*-{}-K10", "individual_heuristic-R{}-{}")
EVERY_CELL = ("individual_heuristic_cells-R{}-{}",)
SAME_NETWORK = (  # joint planning, and individual planning with its network
    ("fcn_grasp-R{}-s*-{}-Kall", "individual_grasp-R{}-s*-{}-Kall"),
    ("fcn_grasp_unmasked-R{}-s*-{}-K10", "individual_grasp_unmasked-R{}-s*-{}-K10"),
)


def rotations_of(joint: str) -> tuple[int, ...]:
    return {"fcn4d": (3, 4), "fcn4d_warm": (4,)}.get(joint.partition("-")[0], ROTATIONS)


def best_of(results, names) -> str | None:
    """The cell with the greatest mean; None until all are there, or have been tried in vain."""
    if any(pooled(results, name) is None for name in names):
        return None
    there = {name: value for name in names if (value := mean(results, name)) is not None}
    return max(there, key=there.get, default=None)


def against(results, joint: str, individual) -> list[Comparison | str | None]:
    """A joint network's cells against the best of these methods', at every tote and R."""
    found = []
    for tote in TOTES:
        for r in rotations_of(joint):
            ours, *rivals = (name.format(r, tote) for name in (joint, *individual))
            if best := best_of(results, rivals):
                found.append(compare(results, f"{tote} R={r}, minus {called(best)}", ours, best, rivals=rivals))
            else:
                found.append(None)
    return found


def joint_beats_individual(results) -> list[Group]:
    """K=10, against the better of the paper's two individual methods."""
    return [Group(joint, against(results, joint + TEN, INDIVIDUAL)) for joint in JOINT]


def joint_beats_every_cell(results) -> list[Group]:
    why = "the more rotations, the more trying every cell makes up for the pick that was fixed beforehand"
    return [Group(joint, against(results, joint + TEN, EVERY_CELL), why) for joint in JOINT]


def learned_beats_joint_dbl(results) -> list[Group]:
    """Deep bottom left, over every pick, place and rotation that is feasible: what is to be beaten without learning."""
    rows = {
        "fcn_grasp-R{}-s*-{}-Kall": "",
        "fcn_grasp_unmasked-R{}-s*-{}-K10": "it is behind with one and two rotations, where its places are worse: "
        "ten actions are enough, its episodes end where nothing is feasible",
        "fcn4d_warm-R{}-s*-{}-Kall": "this is what it imitated, and learning on has not come up to it",
    }
    return [
        Group(name.partition("-")[0], against(results, name, ("joint_dbl-R{}-{}",)), why) for name, why in rows.items()
    ]


def joint_beats_the_same_network(results) -> list[Group]:
    """The pick by heuristic, and all else as for the joint policy."""
    note = "with four rotations the heuristic's pick reaches every cell of the tote, too"
    return [
        Group(joint.partition("-")[0], against(results, joint, (single,)), note=note) for joint, single in SAME_NETWORK
    ]


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
            # Of other episodes, which do not pair: the interval of a difference from those of its sides.
            more = (a - b, a - b - hypot(a - low, higher - b), a - b + hypot(high - a, b - lower))
            sound, verdict = ours.sound and theirs.sound, decided(*more[1:], 0.0)
            verdict = None if not sound or (verdict and low <= 0) else verdict  # a smaller loss is no gain
            remark = ours.remark or theirs.remark
            text, single = f"R={r}, gain at {small} minus at {wide}", ours.single or theirs.single
            found.append(Comparison(text + ", one seed" * single, verdict, more, remark, sound, single))
    why = "individual policies without a mask, trained at height 5, pack totes of height 10 badly at R=1, wide ones too"
    return Group(joint.partition("-")[0], found, why)


def k_settles(results) -> list[Group]:
    """It still rises from K=3 to K=10, and no more from there to K=50."""
    groups = []
    for joint in ("fcn_grasp_unmasked", "fcn_grasp", "fcn4d"):
        names = {k: f"{joint}-R3-s*-6x6x5-K{k}" for k in (3, 10, 50)}
        rise = compare(results, "K=10 minus K=3", names[10], names[3], margin=0.01, learned=[names[10]])
        if isinstance(rise, Comparison) and rise.verdict is False:
            rise = replace(rise, remark=f"{called(joint)} has settled by K=3")
        more = compare(results, "K=50 minus K=10", names[50], names[10], margin=0.01, learned=[names[10]])
        if isinstance(more, Comparison) and more.verdict is not None:
            reason = "" if not more.verdict else f"{called(joint)}, not sure of what is feasible, gains beyond K=10"
            more = replace(more, verdict=not more.verdict, remark=reason)
        groups.append(Group(joint, [rise, more]))
    return groups


#: Networks as they are used, and the K that they are used with.
USED = (
    "fcn_grasp-R{}-s*-{}-Kall",
    "fcn_grasp_unmasked-R{}-s*-{}-K10",
    "fcn4d-R{}-s*-{}-K10",
    "fcn4d_warm-R{}-s*-{}-Kall",
)


def no_loss_with_size(results) -> list[Group]:
    """No tote but 6x6x10 is packed worse than 6x6x5 by more than a hundredth."""
    groups = []
    for network in USED:
        found = []
        for r in rotations_of(network):
            small = network.format(r, TOTES[0])
            for tote in TOTES[2:]:
                text = f"{tote} minus 6x6x5, R={r}"
                found.append(compare(results, text, network.format(r, tote), small, -0.01, learned=[small]))
        groups.append(Group(network.partition("-")[0], found))
    return groups


def high_tote_is_harder(results) -> list[Group]:
    why = "it may be that what is lost at the rim weighs half as much where twice as many layers below it are full"
    groups = []
    for network in USED:
        found = []
        for r in rotations_of(network):
            low, high = (network.format(r, tote) for tote in TOTES[:2])
            found.append(compare(results, f"6x6x5 minus 6x6x10, R={r}", low, high, learned=[low]))
        groups.append(Group(network.partition("-")[0], found, why))
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
    remark = "" if learned else f"a seed of fcn4d has {min(paper):.2f} by then: there is nothing to be worse than"
    note = "trained on another processor, seed 1 of fcn4d learnt nothing" if verdict else ""
    return [Group("typical", [Comparison(text, verdict, (middle, low, high), remark)], note=note)]


def at(curve: dict, frames: int) -> float:
    """The last validation until then."""
    pairs = zip(curve["validation_frames"], curve["validation_occupancy"], strict=True)
    return [value for when, value in pairs if when <= frames][-1]


def clipping_helps(results) -> list[Group]:
    """Where the tote is higher than the clip: trained there with it, or low with it, against trained there without."""
    grasp = []
    for method, where in (("fcn_grasp_high", "there"), ("fcn_grasp", "at 6x6x5")):
        names = [f"{each}-R4-s*-6x6x10-Kall" for each in (method, "fcn_grasp_noclip")]
        text = f"6x6x10, clipped and trained {where}, minus trained there and not clipped"
        grasp.append(compare(results, text, *names, learned=names))
    paper = []
    for tote in ("6x6x10", "10x10x10", "30x30x10"):
        names = [f"{method}-R4-s*-{tote}-K1" for method in ("fcn4d_noclip", "fcn4d")]
        paper.append(compare(results, f"{tote}, clipped minus not", *reversed(names), learned=names))
    return [Group("fcn_grasp", grasp), Group("fcn4d", paper)]


def mcts_far_behind(results) -> list[Group]:
    """By more than a tenth of the tote, behind a policy at K=1."""
    cells = {"with a mask MCTS": "mcts-R4-6x6x5-mask_true", "without one": "mcts-R4-6x6x5-mask_false"}
    cells |= {"random feasible choices": "random-R4-6x6x5"}
    note = ""
    if all(mean(results, name) is not None for name in cells.values()):
        of = [
            f"{text} {mean(results, name):.3f} ({results[name]['episodes']} episodes)" for text, name in cells.items()
        ]
        note = f"most of it is the mask: at 6x6x5 {', '.join(of)}"
    groups = []
    for joint in JOINT:
        found = []
        for tote in TOTES:
            ours, tree = f"{joint}-R4-s*-{tote}-K1", f"mcts-R4-{tote}-mask_false"
            found.append(compare(results, f"{tote}, minus mcts", ours, tree, margin=0.1))
        groups.append(Group(joint, found, note=note))
    return groups


def large_totes_work(results) -> list[Group]:
    """At least 0.8 of a 30x30 tote."""
    groups = []
    for network in USED:
        found = []
        for r, tote in product(rotations_of(network), TOTES[4:]):
            name = network.format(r, tote)
            cell = pooled(results, name)
            if not cell or "occupancy" not in cell:
                found.append(ATTEMPTED if cell else None)
                continue
            low, high = cell["occupancy"]["ci95"]
            gap = (cell["occupancy"]["mean"] - 0.8, low - 0.8, high - 0.8)
            told, single = how_many_seeds([(each, "") for each in seeds(results, name)])
            few = cell["episodes"] < FEW
            text = f"{tote} minus 0.8, R={r}{told}" + f" ({cell['episodes']} episodes)" * few
            verdict = None if few else decided(gap[1], gap[2], 0.0)
            remark = "" if few or verdict else untrained(results, name)
            sound = not few and not remark
            found.append(Comparison(text, verdict if sound else None, gap, remark, sound, single))
        groups.append(Group(network.partition("-")[0], found))
    return groups


HOW = f"""For each network, with all training seeds that met a tote. A difference is that of the same episodes. Its
interval is the 95% interval over episodes, each the mean over seeds, widened to the range of the seeds: between
two methods, of each seed of the one against each of the other. So it tells of these trainings, not of all that
there could be: three seeds are above three others by chance once in twenty, above one other once in four, and
one against one tells nothing of the next; how many verdicts rest on one seed, of one side at least, is said.
*Yes* and *no* need an interval that lies on one side of what the claim is taken to mean, {FEW} episodes, and of
who loses a training that came up to its tote's height, or one cell less; else it is *undecided*. Numbers count
comparisons. Episodes are those that all seeds of both sides have played. Gains on small totes are held against gains
on wider ones, which are of other episodes; whether typical learns poorly is told by validations while training and
the range of the seeds; clipping by policies that were trained to the end with it and without.
"""

#: What the paper says, what we take it to mean, and what holds it against our figures.
CLAIMS = [
    (
        "Joint planning beats individual planning",
        "K=10, the better of the paper's two individual methods",
        joint_beats_individual,
    ),
    (
        "beyond the paper: joint planning beats individual planning with the same network",
        "all alike but for the pick, and a limit of 50,000 frames a level with a mask",
        joint_beats_the_same_network,
    ),
    (
        "beyond the paper: joint planning also beats the heuristic that tries every cell",
        "K=10",
        joint_beats_every_cell,
    ),
    ("beyond the paper: what is learned beats joint DBL, which needs no learning", "", learned_beats_joint_dbl),
    ("most on small totes", "what is gained at 6x6 minus what is gained in wider totes as high", most_on_small_totes),
    (
        "beyond the paper: that gain is the largest on small totes",
        "the same, with the same network",
        most_on_small_totes_with_the_same_network,
    ),
    (
        "K settles near 10",
        "R=3; K=10 is above K=3 by more than 0.01, and K=50 above K=10 by less",
        k_settles,
    ),
    ("No loss as totes grow", "by more than 0.01, at every R", no_loss_with_size),
    ("6x6x10 is packed less well than 6x6x5", "at every R", high_tote_is_harder),
    (
        "A fully connected (typical) network learns poorly",
        "R=4; each seed by more than 0.05 below each of fcn4d, after as many frames",
        typical_learns_poorly,
    ),
    ("Depth clipping helps", "R=4, where the tote is higher than the clip", clipping_helps),
    ("MCTS is far behind", "R=4, K=1, by more than 0.1, neither with a mask", mcts_far_behind),
    ("30x30 totes are packed well by a policy trained at 6x6x5", "0.8 or more, at every R", large_totes_work),
]


def verdict(groups: list[Group]) -> str:
    """The verdict for each network."""
    words = {called(group.name): group.word() for group in groups}
    return "<br>".join(f"{name}: {word}" for name, word in words.items())


def reasons(groups: list[Group]) -> str:
    """Why networks do not bear a claim out, and what to know of those that do."""
    return "; ".join(dict.fromkeys(reason for group in groups for reason in group.reasons()))


def table(results) -> list[str]:
    """Lines of a table, claim, verdict and why; and of a list with the differences behind each."""
    checked = [
        (claim, f"{claim}<br>*{meaning}*" if meaning else claim, check(results)) for claim, meaning, check in CLAIMS
    ]
    lines = ["| the paper's claim, *and how we take it* | our figures bear it out | why not, and what to know |"]
    lines += ["|---|---|---|"]
    lines += [f"| {taken} | {verdict(groups)} | {reasons(groups)} |" for _, taken, groups in checked]
    lines += ["", "The differences of occupancy behind each verdict, and their intervals:", ""]
    for claim, _, groups in checked:
        lines += [f"- **{claim}**", *(f"  - {evidence}" for group in groups if (evidence := group.evidence()))]
    return lines
