"""The paper's claims, each held against our figures: borne out, not, or not known yet."""

from figures import TOTES


def mean(results, name) -> float | None:
    """Mean occupancy of a cell, None where there is none yet."""
    return results[name]["occupancy"]["mean"] if "occupancy" in results.get(name, {}) else None


def known(*values) -> bool:
    return all(value is not None for value in values)


def joint_beats_individual(results):
    """R=3, K=10: the paper's two networks, and ours, against the best individual method."""
    gaps, words = {}, []
    for tote in TOTES:
        joint = [mean(results, f"{name}-R3-s0-{tote}-K10") for name in ("fcn4d", "fcn_grasp_unmasked")]
        names = (f"individual_rl-R3-s0-{tote}-K10", *(f"individual_heuristic{end}-R3-{tote}" for end in ("", "_cells")))
        alone = [mean(results, name) for name in names]
        if known(*joint, *alone):
            gaps[tote] = joint[1] - max(alone)
            words.append(f"{tote}: fcn4d {joint[0] - max(alone):+.3f}, fcn_grasp {gaps[tote]:+.3f}")
    if "6x6x5" not in gaps:
        return None, ""
    ours = min(gaps.values()) > 0
    return ours, "against the best individual method, R=3, K=10. " + "; ".join(words)


def most_on_small_totes(results):
    gaps = {}
    for tote in TOTES:
        names = (f"{name}-R3-{tote}" for name in ("individual_heuristic", "individual_heuristic_cells"))
        values = mean(results, f"fcn_grasp_unmasked-R3-s0-{tote}-K10"), *(mean(results, name) for name in names)
        if known(*values):
            gaps[tote] = values[0] - max(values[1:])
    if not {"6x6x5", "10x10x5"} <= set(gaps):
        return None, ""
    words = ", ".join(f"{tote} {gap:+.3f}" for tote, gap in gaps.items())
    return max(gaps, key=gaps.get) in (
        "6x6x5",
        "6x6x10",
    ), f"fcn_grasp minus the better individual heuristic, R=3: {words}"


def k_settles(results):
    texts, verdicts = [], []
    for method in ("fcn4d", "fcn_grasp_unmasked"):
        at = {k: mean(results, f"{method}-R3-s0-6x6x5-K{k}") for k in (1, 10, 50)}
        if known(*at.values()):
            verdicts.append(abs(at[50] - at[10]) < 0.01)
            texts.append(f"{method}: K=1 {at[1]:.3f}, 10 {at[10]:.3f}, 50 {at[50]:.3f}")
    return (all(verdicts) if verdicts else None), "; ".join(texts)


def no_loss_with_size(results):
    texts, verdicts = [], []
    for method, k in (("fcn4d", 10), ("fcn_grasp_unmasked", 10), ("fcn_grasp", "all")):
        at = {tote: mean(results, f"{method}-R4-s0-{tote}-K{k}") for tote in TOTES}
        at = {tote: value for tote, value in at.items() if value is not None}
        if {"6x6x5", "10x10x5"} <= set(at):
            verdicts.append(all(value >= at["6x6x5"] - 0.01 for tote, value in at.items() if tote != "6x6x10"))
            texts.append(f"{method}: " + ", ".join(f"{tote} {value:.3f}" for tote, value in at.items()))
    return (all(verdicts) if verdicts else None), "; ".join(texts)


def high_tote_is_harder(results):
    texts, verdicts = [], []
    for method, k in (("fcn4d", 10), ("fcn_grasp_unmasked", 10), ("fcn_grasp", "all")):
        pair = [mean(results, f"{method}-R4-s0-{tote}-K{k}") for tote in ("6x6x5", "6x6x10")]
        if known(*pair):
            verdicts.append(pair[1] < pair[0])
            texts.append(f"{method}: {pair[0]:.3f} and {pair[1]:.3f}")
    return (any(verdicts) if verdicts else None), "; ".join(texts)


def final(results, names) -> list[float]:
    """The last validation of each training."""
    curves = [results[name].get("curve") for name in names if name in results]
    return [curve["validation_occupancy"][-1] for curve in curves if curve and curve["validation_occupancy"]]


def typical_learns_poorly(results):
    typical = final(results, [f"typical-6x6x5-s{seed}" for seed in range(3)])
    paper = final(results, [f"fcn4d-R4-s{seed}" for seed in range(3)])
    if not typical or not paper:
        return None, ""
    return max(typical) < min(paper), f"last validation, each seed: typical {show(typical)}; fcn4d {show(paper)}"


def clipping_helps(results):
    without = final(results, [f"fcn4d_noclip-6x6x5-s{seed}" for seed in range(3)])
    clipped = final(results, [f"fcn4d-R4-s{seed}" for seed in range(3)])
    if not without or not clipped:
        return None, ""
    better = sum(clipped) / len(clipped) > sum(without) / len(without)
    return better, f"last validation at 6x6x5, each seed: clipped {show(clipped)}; not clipped {show(without)}"


def show(values) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def mcts_far_behind(results):
    texts, verdicts = [], []
    for tote in TOTES:
        tree, policy = mean(results, f"mcts-R4-{tote}-mask_false"), mean(results, f"fcn4d-R4-s0-{tote}-K1")
        masked = mean(results, f"mcts-R4-{tote}-mask_true")
        if known(tree):
            verdicts.append(
                tree < (policy if policy is not None else mean(results, f"fcn_grasp-R4-s0-{tote}-Kall") or 1)
            )
            beside = "" if policy is None else f", fcn4d {policy:.3f}"
            texts.append(f"{tote}: {tree:.3f}{'' if masked is None else f' (over outcomes {masked:.3f})'}{beside}")
    return (all(verdicts) if verdicts else None), "; ".join(texts)


def large_totes_work(results):
    texts, verdicts = [], []
    for tote in ("30x30x5", "30x30x10"):
        for method, k in (("fcn4d", 10), ("fcn_grasp", "all")):
            value = mean(results, f"{method}-R4-s0-{tote}-K{k}")
            if known(value):
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
     "with few frames a policy makes a mistake now and then, and a large tote gives it more occasions"),
    ("6x6x10 is packed less well than 6x6x5", high_tote_is_harder,
     "where nearly every layer is filled, what is lost at the rim weighs half as much in a tote twice as high"),
    ("A fully connected (typical) network learns poorly", typical_learns_poorly, ""),
    ("Depth clipping helps", clipping_helps, ""),
    ("MCTS is far behind", mcts_far_behind, ""),
    ("30x30 totes are packed well by a policy trained at 6x6x5", large_totes_work,
     "as above: few frames, many occasions"),
]  # fmt: skip


def table(results) -> list[str]:
    """Lines of a table: claim, verdict, figures; and why, where we find otherwise."""
    lines = ["| the paper's claim | our figures bear it out | figures |", "|---|---|---|"]
    for claim, check, why in CLAIMS:
        verdict, evidence = check(results)
        word = {None: "not known yet", True: "yes", False: "no"}[verdict]
        if verdict is False and why:
            word += f": {why}"
        lines.append(f"| {claim} | {word} | {evidence} |")
    return lines
