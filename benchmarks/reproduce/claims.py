"""The paper's claims, each held against our figures: borne out, not, or not known yet."""

import torch
from figures import TOTES

from pickplace.evaluate import confidence95


def mean(results, name) -> float | None:
    """Mean occupancy of a cell, None where there is none yet."""
    return results[name]["occupancy"]["mean"] if "occupancy" in results.get(name, {}) else None


def difference(ours: dict, theirs: dict) -> tuple[float, float, float] | None:
    """Mean occupancy of one result minus another's and its 95% interval, over the episodes that both have played."""
    pairs = zip(ours["occupancy"]["per_episode"], theirs["occupancy"]["per_episode"], strict=False)
    gaps = torch.tensor([a - b for a, b in pairs], dtype=torch.float64)
    return (float(gaps.mean()), *confidence95(gaps, least=-1.0)) if len(gaps) > 1 else None


def gap(results, ours: str, theirs: str, margin: float = 0.0) -> tuple[bool | None, str] | None:
    """Is one cell above another by more than a margin? None in the pair: not to be told apart. And the difference.

    Returns:
        None where one of them is not there.
    """
    if mean(results, ours) is None or mean(results, theirs) is None:
        return None
    centre, low, high = difference(results[ours], results[theirs])
    verdict = True if low > margin else False if high < margin else None
    return verdict, f"{centre:+.3f} ({low:+.3f} to {high:+.3f})"


def judged(comparisons: list) -> tuple[bool | None, str]:
    """All of them: yes if each is, no if one is surely not; and what was found. ``(text, gap(...))`` each."""
    found = [(text, pair) for text, pair in comparisons if pair is not None]
    verdicts = [pair[0] for _, pair in found]
    words = "; ".join(f"{text} {pair[1]}" for text, pair in found)
    if not found:
        return None, ""
    return False if False in verdicts else None if None in verdicts else True, words


JOINT = ("fcn4d", "fcn_grasp_unmasked")
ALONE = ("individual_rl-R3-s0-{}-K10", "individual_heuristic-R3-{}", "individual_heuristic_cells-R3-{}")


def joint_beats_individual(results):
    """R=3, K=10, each joint network against the best individual method there is."""
    comparisons = []
    for tote in TOTES:
        names = [name.format(tote) for name in ALONE]
        values = {name: mean(results, name) for name in names}
        if None in values.values():
            continue
        best = max(values, key=values.get)
        for joint in JOINT:
            pair = gap(results, f"{joint}-R3-s0-{tote}-K10", best)
            comparisons.append((f"{tote}, {joint} minus {best.partition('-')[0]}", pair))
    return judged(comparisons)


def most_on_small_totes(results):
    gaps = {}
    for tote in TOTES:
        values = [mean(results, name.format(tote)) for name in ALONE]
        ours = mean(results, f"fcn_grasp_unmasked-R3-s0-{tote}-K10")
        if ours is not None and None not in values:
            gaps[tote] = ours - max(values)
    if not {"6x6x5", "10x10x5"} <= set(gaps):
        return None, ""
    words = ", ".join(f"{tote} {value:+.3f}" for tote, value in gaps.items())
    small = max(gaps, key=gaps.get) in ("6x6x5", "6x6x10")
    return small, f"fcn_grasp_unmasked minus the best individual method, R=3: {words}"


def k_settles(results):
    """From K=10 to K=50 less than a hundredth is gained."""
    comparisons = []
    for joint in JOINT:
        pair = gap(results, f"{joint}-R3-s0-6x6x5-K50", f"{joint}-R3-s0-6x6x5-K10", margin=0.01)
        less = pair and ({True: False, False: True, None: None}[pair[0]], pair[1])
        comparisons.append((f"{joint}, K=50 minus K=10", less))
    return judged(comparisons)


SIZES = (("fcn4d", 10), ("fcn_grasp_unmasked", 10), ("fcn_grasp", "all"))


def no_loss_with_size(results):
    """No tote but 6x6x10 is packed worse than 6x6x5 by more than a hundredth."""
    comparisons = []
    for method, k in SIZES:
        for tote in TOTES[2:]:
            pair = gap(results, f"{method}-R4-s0-{tote}-K{k}", f"{method}-R4-s0-6x6x5-K{k}", margin=-0.01)
            comparisons.append((f"{method}, {tote} minus 6x6x5", pair))
    return judged(comparisons)


def high_tote_is_harder(results):
    comparisons = []
    for method, k in SIZES:
        pair = gap(results, f"{method}-R4-s0-6x6x5-K{k}", f"{method}-R4-s0-6x6x10-K{k}")
        comparisons.append((f"{method}, 6x6x5 minus 6x6x10", pair))
    return judged(comparisons)


def final(results, names) -> list[float]:
    """The last validation of each training."""
    curves = [results[name].get("curve") for name in names if name in results]
    return [curve["validation_occupancy"][-1] for curve in curves if curve and curve["validation_occupancy"]]


def typical_learns_poorly(results):
    """Every seed of it ends below every seed of fcn4d."""
    typical = final(results, [f"typical-6x6x5-s{seed}" for seed in range(3)])
    paper = final(results, [f"fcn4d-R4-s{seed}" for seed in range(3)])
    if not typical or not paper:
        return None, ""
    return max(typical) < min(paper), f"last validation, each seed: typical {show(typical)}; fcn4d {show(paper)}"


def clipping_helps(results):
    """Where the tote is higher than the clip: trained low with it, against trained at the size itself without."""
    comparisons = []
    for tote in ("6x6x10", "10x10x10", "30x30x10"):
        pair = gap(results, f"fcn4d-R4-s0-{tote}-K1", f"fcn4d_noclip-R4-s0-{tote}-K1")
        names = ("fcn4d-R4-s0-{}-K1", "fcn4d_noclip-R4-s0-{}-K1", "random-R4-{}")
        *trained, chance = (mean(results, name.format(tote)) for name in names)
        if pair and (chance is None or max(trained) < chance):
            pair = None, f"{pair[1]}, where even random feasible choices do better than either"
        comparisons.append((f"{tote}, clipped minus not clipped", pair))
    return judged(comparisons)


def show(values) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def mcts_far_behind(results):
    """By more than a tenth of the tote, behind fcn4d and fcn_grasp without a mask."""
    comparisons = []
    for tote in TOTES:
        for joint in JOINT:
            pair = gap(results, f"{joint}-R4-s0-{tote}-K1", f"mcts-R4-{tote}-mask_false", margin=0.1)
            comparisons.append((f"{tote}, {joint} minus mcts", pair))
    return judged(comparisons)


def large_totes_work(results):
    """At least 0.8 of a 30x30 tote."""
    texts, verdicts = [], []
    for tote in ("30x30x5", "30x30x10"):
        for method, k in (("fcn4d", 10), ("fcn_grasp", "all")):
            value = mean(results, f"{method}-R4-s0-{tote}-K{k}")
            if value is not None:
                verdicts.append(value > 0.8)
                texts.append(f"{method} {tote} {value:.3f}")
    return (all(verdicts) if verdicts else None), ", ".join(texts)


#: What the paper says, what holds it against our figures, and why they differ where they do.
CLAIMS = [
    ("Joint planning beats individual planning", joint_beats_individual,
     "fcn4d has a small part of the paper's 25 million frames here; with the cheaper network the claim can be judged"),
    ("most on small totes", most_on_small_totes, ""),
    ("K settles near 10", k_settles,
     "a policy that has been trained long enough needs no second candidate; one that has not gains from more than 10"),
    ("No loss as totes grow", no_loss_with_size,
     "fcn4d came to a tote height of 2 in its hour; it loses where totes are higher, not where they are wider"),
    ("6x6x10 is packed less well than 6x6x5", high_tote_is_harder,
     "where nearly every layer is filled, what is lost at the rim weighs half as much in a tote twice as high"),
    ("A fully connected (typical) network learns poorly", typical_learns_poorly, ""),
    ("Depth clipping helps", clipping_helps, ""),
    ("MCTS is far behind", mcts_far_behind, ""),
    ("30x30 totes are packed well by a policy trained at 6x6x5", large_totes_work,
     "as above"),
]  # fmt: skip


def table(results) -> list[str]:
    """Lines of a table: claim, verdict, figures; and why, where we find otherwise."""
    lines = ["| the paper's claim | our figures bear it out | figures |", "|---|---|---|"]
    for claim, check, why in CLAIMS:
        verdict, evidence = check(results)
        word = {None: "undecided" if evidence else "not known yet", True: "yes", False: "no"}[verdict]
        if verdict is False and why:
            word += f": {why}"
        lines.append(f"| {claim} | {word} | {evidence} |")
    return lines
