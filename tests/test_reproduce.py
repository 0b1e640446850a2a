"""The comparison: its cells are commands that exist, and what it writes follows from the results."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cells
import claims
import figures
import placement_only
import pytest
import results
import run
from cell import BATCH, fitting_batch
from hydra import compose, initialize_config_dir

from pickplace import PickPlaceEnv
from pickplace.runs import hydra_app as config
from pickplace.runs.loggers import CsvLogger
from pickplace.task.items import Kinds

FOLDER = Path(__file__).parents[1] / "benchmarks" / "reproduce"

TRAININGS, PARTS = cells.read()


def test_trainings_and_evaluations_of_every_method_compose():
    evaluations = {cell.name: cell for part in PARTS.values() for cell in part if cell.kind == "evaluate"}
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        for cell in {cell.method: cell for cell in TRAININGS.values()}.values():  # of each method the last
            assert compose("train", list(cell.overrides)).total_frames >= 300_000
        for overrides in {
            (cell.method, *sorted(dict(cell.axes))): cell.overrides for cell in evaluations.values()
        }.values():
            assert compose("evaluate", list(overrides)).evaluation.stream == "test"


def test_an_entry_stands_for_every_combination_of_its_grid():
    entry = {"method": "m", "set": "a=1 b=2", "training": "t-R{R}-s{seed}", "grid": {"R": [1, 4], "seed": [0, 1]}}
    made = cells.expand(entry, "evaluate")
    assert [cell.name for cell in made] == ["m-R1-s0", "m-R1-s1", "m-R4-s0", "m-R4-s1"]
    assert made[1].overrides == ("a=1", "b=2", "env.rotations=1")  # the seed is the training's
    assert made[1].training == "t-R1-s1"
    assert cells.expand({"method": "m", "grid": {"seed": [3], "tote": ["6x6x10"]}}, "train")[0].overrides == (
        "seed=3",
        "env.tote_size=[6,6,10]",
    )


@pytest.mark.parametrize("entry", [{"method": "m", "gird": {}}, {"method": "m", "grid": {"Q": [1]}}])
def test_an_entry_with_a_misspelt_key(entry):
    with pytest.raises(ValueError, match="gird|grid.Q"):
        cells.expand(entry, "train")


def result(mean, episodes=100, **more):
    """Episodes of which every other one is a little better."""
    each = [mean + 0.001 * (number % 2) for number in range(episodes)]
    occupancy = {"mean": mean, "ci95": [mean - 0.01, mean + 0.01], "per_episode": each}
    return {"occupancy": occupancy, "episodes": episodes, "latency_ms": {"p50": 2.0}, **more}


def training(level, *validations, tote="6,6,5", **more):
    """A training that came so high, and what it validated every 100 frames."""
    frames = [100 * (number + 1) for number in range(len(validations))]
    curve = {"level": [1, level], "validation_frames": frames, "validation_occupancy": [*validations]}
    return {"curve": curve, "frames": 1000, "command": f"train env.tote_size=[{tote}] seed=0", **more}


def words(groups):
    return {group.name: group.word() for group in groups}


def test_k_settles_near_ten_where_ten_are_better_than_three_and_fifty_no_better():
    def claim(three, ten, fifty):
        means = {3: three, 10: ten, 50: fifty}
        groups = claims.k_settles({f"fcn4d-R3-s0-6x6x5-K{k}": result(mean) for k, mean in means.items()})
        assert {words(groups).pop(name) for name in ("fcn_grasp", "fcn_grasp_unmasked")} == {"not known yet"}
        return words(groups)["fcn4d"], claims.reasons(groups)

    one = "(by one seed)"
    assert claim(0.8, 0.9, 0.905) == ("yes, all 2 (2 by one seed)", "")
    beyond = "*fcn4d (the paper's)*, not sure of what is feasible, gains beyond K=10"
    assert claim(0.8, 0.9, 0.95) == (f"1 yes {one}, 1 no {one}", beyond)
    assert claim(0.9, 0.9, 0.9) == (f"1 yes {one}, 1 no {one}", "*fcn4d (the paper's)* has settled by K=3")


def test_mcts_is_far_behind_where_a_trained_policy_is():
    tree = {"mcts-R4-6x6x5-mask_false": result(0.3)}
    assert set(words(claims.mcts_far_behind(tree)).values()) == {"not known yet"}  # behind what?
    ours = {"training": "t"}
    waiting = ", 5 not known yet"
    for mean, level, word in (
        (0.5, 5, "1 yes (by one seed)"),
        (0.35, 5, "1 no (by one seed)"),
        (0.35, 2, "1 undecided"),
    ):
        found = tree | {"fcn4d-R4-s0-6x6x5-K1": result(mean, **ours), "t": training(level)}
        assert words(claims.mcts_far_behind(found))["fcn4d"] == word + waiting
    came = "*fcn4d (the paper's)* came to a tote height of 2 of 5 only"
    assert claims.reasons(claims.mcts_far_behind(found)) == came
    found |= {"mcts-R4-6x6x5-mask_true": result(0.9, episodes=12), "random-R4-6x6x5": result(0.25)}
    assert "with a mask MCTS 0.900 (12 episodes), without one 0.300" in claims.reasons(claims.mcts_far_behind(found))


def test_what_an_unfinished_training_gives_does_not_decide_how_sizes_compare():
    cells = {"fcn4d-R4-s0-6x6x5-K10": 0.5, "fcn4d-R4-s0-6x6x10-K10": 0.3}
    found = {name: result(mean, training="t") for name, mean in cells.items()}
    for trained, word in (
        (training(5), "1 yes (by one seed)"),
        (training(2), "1 undecided"),
        (training(5, tote="6,6,10"), "1 undecided"),
    ):
        assert words(claims.high_tote_is_harder(found | {"t": trained}))["fcn4d"] == f"{word}, 1 not known yet"


def test_typical_learns_poorly_where_all_its_seeds_do_after_as_many_frames():
    found = {f"typical-6x6x5-s{seed}": training(1, 0.1, 0.2, 0.9) for seed in range(3)}
    found |= {f"fcn4d-R4-s{seed}": training(1, 0.1, 0.3) for seed in range(3)}
    assert words(claims.typical_learns_poorly(found)) == {"typical": "yes"}  # 0.2 against 0.3; the 0.9 came later
    found["fcn4d-R4-s1"] = training(1, 0.1, 0.24)
    assert words(claims.typical_learns_poorly(found)) == {"typical": "undecided"}
    assert words(claims.typical_learns_poorly({"typical-6x6x5-s0": training(1, 0.1)})) == {"typical": "not known yet"}


def individual(gain_small, gain_wide, alone=0.5):
    """R=3, K=10: what joint planning packs more than each individual method, at 6x6x5 and 10x10x5."""
    found = {}
    for tote, gain in (("6x6x5", gain_small), ("10x10x5", gain_wide)):
        found[f"individual_rl-R3-s0-{tote}-K10"] = result(alone)
        found[f"individual_heuristic-R3-{tote}"] = result(alone - 0.1)
        found[f"individual_heuristic_cells-R3-{tote}"] = result(alone + 0.3)
        found[f"fcn_grasp_unmasked-R3-s0-{tote}-K10"] = result(alone + gain)
    return found


def test_joint_planning_is_held_against_the_best_individual_method():
    found = individual(0.2, 0.1)

    def beats(found):
        return words(claims.joint_beats_individual(found))["fcn_grasp_unmasked"].removesuffix(" not known yet")

    def small(found):
        return words(claims.most_on_small_totes(found))["fcn_grasp_unmasked"].removesuffix(", 15 not known yet")

    assert beats(found) == "2 yes (2 by one seed), 22" and small(found) == "1 yes (by one seed)"
    every_cell = words(claims.joint_beats_every_cell(found))["fcn_grasp_unmasked"]
    assert every_cell == "2 no (2 by one seed), 22 not known yet"
    assert small(individual(0.1, 0.2)) == "1 no (by one seed)"
    behind = individual(-0.1, -0.2)
    assert beats(behind) == "2 no (2 by one seed), 22"
    assert small(behind) == "1 undecided"  # to lose less is no gain
    del found["individual_heuristic-R3-6x6x5"]  # the best of what? attempted in vain is an answer, not yet is none
    assert beats(found) == "1 yes (by one seed), 23"
    found["individual_heuristic-R3-6x6x5"] = {"attempted": "hours"}
    assert beats(found) == "2 yes (2 by one seed), 22"


def test_neither_side_wins_by_what_the_other_was_not_trained_for():
    """An hour may be too short, of our networks and of those that they are held against."""
    found = individual(0.2, 0.1) | {"t": training(3)}
    for tote in ("6x6x5", "10x10x5"):
        found[f"individual_rl-R3-s0-{tote}-K10"]["training"] = "t"
    groups = claims.joint_beats_individual(found)
    assert words(groups)["fcn_grasp_unmasked"] == "2 undecided, 22 not known yet"
    assert claims.reasons(groups) == "*individual, RL (the paper's)* came to a tote height of 3 of 5 only"
    assert words(claims.most_on_small_totes(found))["fcn_grasp_unmasked"] == "1 undecided, 15 not known yet"
    for tote in ("6x6x5", "10x10x5"):  # nor where another of the methods beats it, since trained it might not
        found[f"individual_heuristic-R3-{tote}"] = result(0.55)
    assert words(claims.joint_beats_individual(found))["fcn_grasp_unmasked"] == "2 undecided, 22 not known yet"
    behind = individual(-0.1, -0.1) | {"t": training(3)}  # who wins although it had no time, wins
    behind["individual_rl-R3-s0-6x6x5-K10"]["training"] = "t"
    assert words(claims.joint_beats_individual(behind))["fcn_grasp_unmasked"].startswith("2 no")
    behind["fcn_grasp_unmasked-R3-s0-6x6x5-K10"]["training"] = "t"
    assert words(claims.joint_beats_individual(behind))["fcn_grasp_unmasked"].startswith("1 no (by one seed), 1 undec")


def test_joint_planning_is_held_against_its_own_network_with_and_without_a_mask():
    found = {f"individual_grasp-R1-s0-{tote}-Kall": result(0.6) for tote in ("6x6x5", "10x10x5")}
    found |= {"fcn_grasp-R1-s0-6x6x5-Kall": result(0.9), "fcn_grasp-R1-s0-10x10x5-Kall": result(0.8)}
    assert words(claims.joint_beats_the_same_network(found)) == {
        "fcn_grasp": "2 yes (2 by one seed), 22 not known yet",
        "fcn_grasp_unmasked": "not known yet",
    }
    small = words(claims.most_on_small_totes_with_the_same_network(found))["fcn_grasp"]
    assert small == "1 yes (by one seed), 15 not known yet"
    found["individual_grasp_unmasked-R1-s0-6x6x5-K10"] = result(0.5)
    found["fcn_grasp_unmasked-R1-s0-6x6x5-K10"] = result(0.4)
    same = words(claims.joint_beats_the_same_network(found))["fcn_grasp_unmasked"]
    assert same == "1 no (by one seed), 23 not known yet"


def test_a_difference_within_the_noise_or_of_few_episodes_decides_nothing():
    ours, theirs = result(0.5), result(0.5)
    theirs["occupancy"]["per_episode"] = ours["occupancy"]["per_episode"][1:] + [0.5]
    assert claims.compare({"a": ours, "b": theirs}, "", "a", "b").verdict is None
    assert claims.compare({"a": result(0.6), "b": theirs}, "", "a", "b").verdict is True
    assert claims.compare({"a": result(0.6), "b": theirs}, "", "a", "b", margin=0.2).verdict is False
    assert claims.compare({"a": ours}, "", "a", "b") is None
    for episodes in (1, 2, 19):
        few = result(0.6, episodes)
        comparison = claims.compare({"a": few, "b": theirs}, "it", "a", "b")
        gap = sum(few["occupancy"]["per_episode"]) - sum(theirs["occupancy"]["per_episode"][:episodes])
        assert comparison.verdict is None and comparison.text == f"it ({episodes} episodes)"
        assert comparison.difference[0] == pytest.approx(gap / episodes)


def test_every_seed_of_a_method_must_beat_every_seed_of_another():
    found = {f"individual_grasp-R1-s{seed}-6x6x5-Kall": result(0.6 + 0.01 * seed) for seed in range(3)}
    found["fcn_grasp-R1-s0-6x6x5-Kall"] = result(0.7)
    for mean, word in ((0.65, "1 yes"), (0.61, "1 undecided"), (0.5, "1 undecided")):
        found["fcn_grasp-R1-s2-6x6x5-Kall"] = result(mean)
        groups = claims.joint_beats_the_same_network(found)
        assert words(groups)["fcn_grasp"] == word + ", 23 not known yet"
    [comparison] = groups[0].found
    assert comparison.text.endswith(", 2 seeds against 3 seeds")
    assert comparison.difference == pytest.approx((-0.01, -0.12, 0.1))


def test_a_policy_is_compared_with_itself_where_two_cells_have_it():
    found = {f"fcn_grasp-R4-s{seed}-6x6x5-Kall": result(0.5 + 0.2 * seed) for seed in range(2)}
    found |= {f"fcn_grasp-R4-s{seed}-10x10x5-Kall": result(0.52 + 0.2 * seed) for seed in range(3)}
    group = claims.no_loss_with_size(found)[0]
    assert group.word() == "1 yes, 15 not known yet"
    assert group.found[0].text == "10x10x5 minus 6x6x5, R=4, 2 seeds"
    assert group.found[0].difference == pytest.approx((0.02, 0.02, 0.02))


def test_a_large_tote_that_few_episodes_filled_decides_nothing():
    name = "fcn_grasp-R4-s0-30x30x5-Kall"
    for cell, word in (
        (result(0.9), "1 yes (by one seed)"),
        (result(0.79), "1 undecided"),
        (result(0.7), "1 no (by one seed)"),
        (result(0.9, episodes=5), "1 undecided"),
    ):
        assert words(claims.large_totes_work({name: cell}))["fcn_grasp"] == f"{word}, 7 not known yet"
    other = {name: result(0.9), name.replace("s0", "s1"): result(0.7)}  # the range of the seeds is about 0.8
    assert words(claims.large_totes_work(other))["fcn_grasp"] == "1 undecided, 7 not known yet"


def test_what_was_attempted_in_vain_is_not_waited_for():
    tree = {f"mcts-R4-{tote}-mask_false": result(0.3) for tote in figures.TOTES[:4]}
    tree |= {f"mcts-R4-{tote}-mask_false": {"attempted": "hours"} for tote in figures.TOTES[4:]}
    ours = {f"fcn4d-R4-s0-{tote}-K1": result(0.6) for tote in figures.TOTES}
    assert words(claims.mcts_far_behind(tree | ours))["fcn4d"] == "4 yes (4 by one seed), 2 attempted in vain"
    assert words(claims.mcts_far_behind({name: {"attempted": "hours"} for name in {**tree, **ours}})) == {
        "fcn_grasp_unmasked": "attempted",
        "fcn4d": "attempted",
    }


def test_no_verdict_about_small_totes_from_few_episodes_or_half_a_training():
    found = individual(0.2, 0.1)
    found["fcn_grasp_unmasked-R3-s0-10x10x5-K10"] = result(0.6, episodes=5)
    undecided = {"fcn_grasp_unmasked": "1 undecided, 15 not known yet"}
    assert words(claims.most_on_small_totes(found)) == undecided
    found = individual(0.1, -0.2) | {"t": training(2)}
    found["fcn_grasp_unmasked-R3-s0-10x10x5-K10"]["training"] = "t"
    assert words(claims.most_on_small_totes(found)) == undecided


def test_clipping_is_judged_by_trainings_that_came_up_to_the_clip():
    found = {f"fcn_grasp-R4-s{seed}-6x6x10-Kall": result(0.9) for seed in range(3)}
    found |= {f"fcn_grasp_noclip-R4-s{seed}-6x6x10-Kall": result(0.8, training="t") for seed in range(3)}
    found |= {f"fcn_grasp_high-R4-s{seed}-6x6x10-Kall": result(0.85) for seed in range(3)}
    assert words(claims.clipping_helps(found | {"t": training(10, tote="6,6,10")}))["fcn_grasp"] == "yes, all 2"
    assert words(claims.clipping_helps(found | {"t": training(8, tote="6,6,10")}))["fcn_grasp"] == "undecided"
    short = claims.clipping_helps(found | {"t": training(9, tote="6,6,10")})
    assert words(short)["fcn_grasp"] == "yes, all 2" and "9 of 10" in claims.reasons(short)


def test_every_claim_has_a_row_with_and_without_results():
    for found in ({}, results.load()):
        lines = claims.table(found)
        rows, listed = lines[2 : lines.index("")], [line for line in lines if line.startswith("- ")]
        assert len(rows) == len(listed) == len(claims.CLAIMS) and all(row.count("|") == 4 for row in rows)


def test_seeds_are_drawn_as_one_point_with_the_range_of_both():
    found = {"m-s0": result(0.5), "m-s2": result(0.6), "m-s1": {"attempted": "hours"}}
    assert figures.pooled(found, "m-s*")["occupancy"] == {"mean": 0.55, "ci95": (0.5, 0.6)}
    assert figures.pooled(found, "m-s0")["occupancy"]["ci95"] == (0.49, 0.51)
    assert "attempted" in figures.pooled(found, "m-s1")
    assert figures.pooled(found, "n-s*") is None
    noisy = [result(0.5), result(0.5)]
    for seed, part in enumerate(noisy):  # each has the other's luck, so that their means over seeds are all alike
        part["occupancy"]["per_episode"] = [0.2 + 0.6 * ((number + seed) % 2) for number in range(100)]
    low, high = figures.pooled({"m-s0": noisy[0], "m-s1": noisy[1]}, "m-s*")["occupancy"]["ci95"]
    assert (low, high) == pytest.approx((0.5, 0.5))
    noisy[1]["occupancy"]["per_episode"] = noisy[0]["occupancy"]["per_episode"]
    low, high = figures.pooled({"m-s0": noisy[0], "m-s1": noisy[1]}, "m-s*")["occupancy"]["ci95"]
    assert 0.5 - low == pytest.approx(1.96 * 0.3 / 10, rel=0.03) == high - 0.5


def test_where_other_seeds_alone_met_a_tote_they_are_drawn_and_judged():
    found = {f"fcn4d-R4-s{seed}-6x6x5-K10": result(0.6) for seed in range(3)}
    found |= {f"fcn4d-R4-s{seed}-30x30x5-K10": result(0.5 + 0.2 * seed) for seed in (1, 2)}
    assert figures.pooled(found, "fcn4d-R4-s*-30x30x5-K10")["occupancy"]["mean"] == pytest.approx(0.8)
    group = next(group for group in claims.no_loss_with_size(found) if group.name == "fcn4d")
    assert [str(each) for each in group.found] == ["30x30x5 minus 6x6x5, R=4, 2 seeds +0.2000 (+0.1000 to +0.3000)"]
    found["fcn_grasp_unmasked-R1-s0-6x6x5-K10"] = result(0.5)
    found |= {f"individual_grasp_unmasked-R1-s{seed}-6x6x5-K10": result(0.4) for seed in range(3)}
    group = next(group for group in claims.joint_beats_the_same_network(found) if "unmasked" in group.name)
    assert group.found[0].text.endswith(", one seed against 3 seeds") and group.word().startswith("1 yes (by one seed)")
    against_none = claims.learned_beats_joint_dbl(found | {"joint_dbl-R1-6x6x5": result(0.3)})
    assert next(each for group in against_none for each in group.found).text.endswith("*joint DBL*, one seed")


def test_tables_say_what_is_missing_attempted_and_no_better_than_random():
    cell = next(cell for cell in PARTS["rl_methods"] if cell.name == "typical-R4-s0-6x6x5-K1")
    setting = {"env": {"tote_size": [6, 6, 5], "num_envs": 16}, "items": {"kinds": []}}
    trained = {
        "frames": 1000,
        "frames_asked": 2000,
        "cpu_seconds": 60,
        "peak_mib": 900,
        "warm_start": 0,
        "curve": {"validation_occupancy": [0.2]},
    }
    chance = result(0.26, planner="random", **{**setting, "env": {"tote_size": [6, 6, 5], "num_envs": 256}})
    elsewhere = result(0.1, planner="random", env={"tote_size": [6, 6, 9]}, items=setting["items"])
    found = {cell.training: trained, "random-R4-6x6x5": chance, "random-R4-6x6x9": elsewhere}
    assert "not yet" in results.table([cell], found)[-1]
    found[cell.name] = result(0.21, checkpoint="typical/best", **setting) | {"episodes": 5}
    row = results.table([cell], found)[-1]
    assert "0.2100 (0.2000 to 0.2200) | 5° | 2.0 ms (median, wall) |" in row
    assert "| 1,000 frames of 2,000, 1 min, **no better than random** |" in row
    found[cell.name] = result(0.31, checkpoint="typical/best", **setting)
    found[cell.name]["latency_ms"] = {"p50": 9, "cpu_mean": 1_500}
    assert "| 1.5 s |" in results.table([cell], found)[-1]
    assert "random" not in results.table([cell], found)[-1]
    found[cell.training] = {"attempted": "no memory", "cpu_seconds": 120, "peak_mib": 20480}
    found[cell.name] = {"attempted": "its training"}
    assert "attempted: its training |  |  | attempted, 2 min, 20.0 GiB" in results.table([cell], found)[-1]


def test_every_figure_is_drawn_from_few_results_and_from_none(tmp_path):
    found = {}
    for name, part in PARTS.items():
        assert figures.FIGURES[name][-1]({}, tmp_path / name) is False
        found |= {cell.name: result(0.5 + 0.001 * number) for number, cell in enumerate(part[::2])}
    curve = {"validation_occupancy": [0.3, 0.5], "validation_frames": [100, 200]}
    assert not set(found) & set(TRAININGS)
    found |= {name: {"curve": curve} for name in TRAININGS}
    shares = {key: {"mean": 0.5, "ci95": [0.4, 0.6]} for key in ("occupancy_planned", "occupancy")}
    # Whatever a result may be: attempted, of few episodes, of a training that was cut short, of some seeds only.
    for number, name in enumerate(sorted(name for name in found if name not in TRAININGS)):
        if number % 5 == 1:
            found[name] = {"attempted": "to fill one tote would take 3.0 hours", "peak_mib": 900}
        elif number % 5 == 2:
            found[name] |= {"episodes": 3}
        elif number % 5 == 3:
            found[name] |= {"training": "short"}
    found |= {f"fcn_grasp-R3-s{seed}-6x6x5-Kall": {"attempted": "hours"} for seed in range(3)}
    found["py3dbp-R1-6x6x5"] = {"kind": "placement_only", "placements": {"executed": 3, "unstable": 1}, **shares}
    found["short"] = {"frames": 10, "frames_asked": 30}
    for name, (_, _, draw) in figures.FIGURES.items():
        assert draw(found, tmp_path / name) is True
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.svg").read_text().startswith("<?xml")


def test_the_numbers_behind_a_figure_are_those_of_its_cells():
    cell = next(cell for cell in PARTS["rl_methods"] if cell.name == "fcn4d-R4-s0-6x6x10-K1")
    curve = {"validation_frames": [100], "validation_occupancy": [0.3]}
    found = {cell.name: result(0.21, method="fcn4d", versions={}), cell.training: {"frames": 100, "curve": curve}}
    behind = results.behind(PARTS["rl_methods"], found)
    assert behind == {
        "cells": {
            cell.name: {
                "training": "fcn4d-R4-s0",
                "method": "fcn4d",
                "occupancy": {"mean": 0.21, "ci95": [0.21 - 0.01, 0.21 + 0.01]},
                "episodes": 100,
                "latency_ms": {"p50": 2.0},
            }
        },
        "trainings": {"fcn4d-R4-s0": {"frames": 100, "curve": curve}},
    }
    assert json.loads(run.one_line_a_list(behind)) == behind
    assert results.behind(PARTS["rl_methods"], {}) == {"cells": {}, "trainings": {}}


def test_a_plan_of_single_cells_can_be_executed_but_where_the_effector_collides():
    """A 4x4x2 tote, items 1x1x1 in reading order: the plan fills the first layer; walls are in the way of none."""
    env = PickPlaceEnv(tote_size=(4, 4, 2), items=Kinds([(1, 1, 1)]), num_envs=1, stream="test")

    def packer(size, turns):
        places = iter([(x, y, z) for z in (0, 1) for x in range(4) for y in range(4)])
        return lambda w, d, h: (*place, 1, 1) if (place := next(places, None)) else None

    outcomes, planned, executed = placement_only.replay(env, packer)
    assert (len(outcomes), planned, executed, set(outcomes)) == (32, 1.0, 1.0, {"executed"})

    def towers(size, turns):
        places = iter([(x, y, z) for x in range(4) for y in range(4) for z in (0, 1)])
        return lambda w, d, h: (*place, 1, 1) if (place := next(places, None)) else None

    outcomes, planned, executed = placement_only.replay(env, towers)
    assert planned == 1.0
    assert executed < 1.0
    assert set(outcomes) == {"executed", "effector_collides"}

    def floating(size, turns):
        return lambda w, d, h: (0, 0, 1, 1, 1)

    assert placement_only.replay(env, floating)[0][0] == "rests_elsewhere"


KEPT = [*run.RESULTS.glob("cells/*.json"), *run.RESULTS.glob("trainings/*.json")]


@pytest.mark.parametrize("path", sorted(KEPT), ids=lambda path: path.stem)
def test_a_result_that_is_kept_belongs_to_a_cell_of_today(path):
    found = json.loads(path.read_text())
    every = {cell.name: cell for part in PARTS.values() for cell in part} | TRAININGS
    assert found["cell"] == path.stem and path.stem in every
    if every[path.stem].training:  # and to the training as it is kept
        kept = results.RESULTS / "trainings" / f"{every[path.stem].training}.json"
        assert found["of_training"] == run.identity(json.loads(kept.read_text()))
    assert all(word in found["command"] for word in every[path.stem].overrides if "evaluation." not in word)
    assert "attempted" in found or "curve" in found or 0 <= found["occupancy"]["mean"] <= 1
    assert "/tmp" not in path.read_text() and "/home" not in path.read_text()


@pytest.mark.parametrize("name", PARTS)
def test_a_figure_was_drawn_from_the_results_that_are_kept(name):
    drawn = json.loads((run.RESULTS / "figures" / f"{name}.json").read_text())
    kept = results.behind(PARTS[name], results.load())
    assert {key: drawn[key] for key in kept} == kept, "make results"


def test_a_command_that_uses_up_its_budget_is_told_to_end(tmp_path):
    child = run.Child([sys.executable, "-c", "print('busy', flush=True)\nwhile True: pass"], tmp_path / "log")
    cost = child.wait(0.01)
    assert (cost["rc"], child.last_words()) == (-signal.SIGTERM, "busy")
    assert 0.6 <= cost["cpu_seconds"] < 30 and cost["peak_mib"] > 1 and cost["ended_by"] == "budget"


def test_a_training_is_taken_up_where_its_budget_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "OUTPUTS", tmp_path)
    overrides = ("experiment=smoke", "total_frames=2_000_000", "evaluation_interval=2_000_000")
    cell = cells.Cell("tiny", "train", overrides, "tiny", ())
    first = run.train(cell, 0.25)
    assert first["frames"] < first["frames_asked"] == 2_000_000
    assert run.train(cell, 0.25)["frames"] == first["frames"]  # its budget is spent: nothing runs
    again = run.train(cell, 0.4)
    assert again["frames"] > first["frames"] and again["cpu_seconds"] > first["cpu_seconds"]
    assert again["curve"]["frames"][-1] == again["frames"]
    assert run.checkpoint_of("tiny").name == "last"  # it was never validated


def test_what_a_smaller_budget_cut_short_is_computed_again(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "RESULTS", tmp_path)
    trained = cells.Cell("t", "train", (), "t", ())
    tested = cells.Cell("e", "evaluate", ("evaluation.episodes=50",), "e", (), "t")

    def done(cell, minutes, **result):
        path = run.result_of(cell)
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(result))
        return run.is_done(cell, minutes, {"t": trained})

    assert not run.is_done(trained, 60, {})
    assert done(trained, 60, budget_minutes=60, frames=10, frames_asked=20, cpu_seconds=5)
    assert not done(trained, 60, budget_minutes=10, frames=10, frames_asked=20, cpu_seconds=5)
    assert not done(trained, 60, budget_minutes=10, attempted="hours")
    assert done(trained, 60, budget_minutes=10, frames=20, frames_asked=20, cpu_seconds=5)
    now, before = run.identity({"frames": 20}), run.identity({"frames": 10})
    assert not done(tested, 60, budget_minutes=10, episodes=49, of_training=now)
    assert done(tested, 10, budget_minutes=10, episodes=49, of_training=now)
    assert not done(tested, 10, budget_minutes=10, episodes=49, of_training=before)
    assert not done(tested, 10, budget_minutes=10, attempted="its training", of_training=before)
    assert done(tested, 60, budget_minutes=10, episodes=50, of_training=now)
    assert not done(tested, 60, budget_minutes=10, episodes=50, of_training=before)


def test_a_training_whose_weights_are_elsewhere_is_repeated_where_an_evaluation_needs_it(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(run, "OUTPUTS", tmp_path / "outputs")
    trained = cells.Cell("t", "train", (), "t", ())
    tested = cells.Cell("e", "evaluate", (), "e", (), "t")

    def names():
        trainings = {"t": trained}
        return [
            cell.name
            for cell in run.trainings_to_run([tested], trainings, lambda cell: not run.is_done(cell, 60, trainings))
        ]

    def write(cell, **result):
        run.result_of(cell).parent.mkdir(parents=True, exist_ok=True)
        run.result_of(cell).write_text(json.dumps(result))

    def keep_weights(frames):
        folder = run.run_dir_of(trained)
        (folder / "checkpoints" / "last").mkdir(parents=True, exist_ok=True)
        (folder / "checkpoints" / "last" / "state.json").write_text(json.dumps({"frames": frames}))
        table = CsvLogger(folder)
        table.log({"train/occupancy": 0.4, "curriculum/level": 1}, 10)
        table.log({"train/occupancy": 0.5, "curriculum/level": 1, "eval/occupancy": 0.5}, 20)
        table.close()

    curve = {"frames": [10, 20], "training_occupancy": [0.4, 0.5], "level": [1, 1]}
    curve |= {"validation_frames": [20], "validation_occupancy": [0.5]}
    assert names() == ["t"]
    write(trained, frames=20, frames_asked=20, cpu_seconds=5, curve=curve)
    assert names() == ["t"]
    keep_weights(10)  # repeated, and stopped on the way
    assert names() == ["t"]
    with pytest.raises(run.Failed, match="the weights of t are not here"):
        run.compute(tested, 60, {"t": trained})
    keep_weights(20)
    assert names() == []
    shutil.rmtree(run.run_dir_of(trained))
    repeated = {"frames": 20, "cpu_seconds": 7, "curve": curve}
    write(tested, episodes=100, of_training=run.identity(repeated))
    assert names() == []
    curve["validation_occupancy"] = [0.6]
    write(trained, frames=20, frames_asked=20, cpu_seconds=5, curve=curve)
    assert names() == ["t"]
    write(trained, attempted="no memory", budget_minutes=60)
    assert names() == []


def test_a_failure_that_may_pass_leaves_no_result(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "OUTPUTS", tmp_path / "outputs")
    monkeypatch.setattr(run, "RESULTS", tmp_path / "results")
    cell = cells.Cell("wrong", "evaluate", ("planner=nobody",), "wrong", ())
    with pytest.raises(run.Failed, match="exit code 2: error: planner/nobody"):
        run.compute(cell, 1, {})
    with pytest.raises(run.Failed, match="its training, wrong, is not done"):
        run.compute(cells.Cell("e", "evaluate", (), "e", (), "wrong"), 1, {"wrong": cell})
    assert not (tmp_path / "results").exists()


def test_an_evaluation_leaves_the_command_that_gives_the_same(tmp_path, monkeypatch):
    """A planner that draws: neither the pilot nor the budget may change what it draws."""
    monkeypatch.setattr(run, "OUTPUTS", tmp_path / "outputs")
    monkeypatch.setattr(run, "RESULTS", tmp_path / "results")
    overrides = ("planner=random", "evaluation.episodes=20", "env.tote_size=[4,4,1]")
    run.compute(cells.Cell("drawn", "evaluate", overrides, "drawn", ()), 10, {})
    found = json.loads((tmp_path / "results" / "cells" / "drawn.json").read_text())
    command = found["command"].split()[1:]
    assert "evaluation.batch_size=128" in command
    subprocess.run([sys.executable, *command, f"hydra.run.dir={tmp_path / 'again'}"], check=True, capture_output=True)
    again = json.loads((tmp_path / "again" / "evaluation.json").read_text())
    assert again["occupancy"]["mean"] == found["occupancy"]["mean"]


def test_a_batch_is_played_where_it_ends_in_time_and_is_worth_it():
    assert fitting_batch(alone=10, together=20, seconds=60) == (BATCH, 40)
    assert fitting_batch(alone=10, together=70, seconds=60) == (1, 60)  # it would not end
    assert fitting_batch(alone=1, together=0.6 * BATCH, seconds=60) == (1, 60)  # as fast one by one


def test_clipping_helps_where_fcn4d_with_it_is_better():
    for clipped, plain, word in ((0.5, 0.3, "yes, all 3 (3 by one seed)"), (0.3, 0.5, "no, all 3 (3 by one seed)")):
        found = {f"fcn4d-R4-s0-{tote}-K1": result(clipped) for tote in ("6x6x10", "10x10x10", "30x30x10")}
        found |= {f"fcn4d_noclip-R4-s0-{tote}-K1": result(plain) for tote in ("6x6x10", "10x10x10", "30x30x10")}
        assert words(claims.clipping_helps(found))["fcn4d"] == word


def test_no_loss_is_a_loss_of_less_than_a_hundredth():
    for wide, word in ((0.495, "1 yes (by one seed)"), (0.5, "1 yes (by one seed)"), (0.48, "1 no (by one seed)")):
        found = {"fcn4d-R4-s0-6x6x5-K10": result(0.5), "fcn4d-R4-s0-10x10x5-K10": result(wide)}
        assert words(claims.no_loss_with_size(found))["fcn4d"] == f"{word}, 7 not known yet"


def test_a_gain_on_small_totes_is_as_unsure_as_both_of_its_sides():
    found = {}
    for tote, gain, noise in (("6x6x5", 0.2, 0.0), ("10x10x5", 0.1, 0.6)):
        found[f"individual_grasp-R1-s0-{tote}-Kall"] = result(0.3)
        found[f"fcn_grasp-R1-s0-{tote}-Kall"] = result(0.3 + gain)
        each = found[f"fcn_grasp-R1-s0-{tote}-Kall"]["occupancy"]["per_episode"]
        each[:] = [share + noise * (-1) ** number for number, share in enumerate(each)]
    group = claims.most_on_small_totes_with_the_same_network(found)[0]
    assert group.word() == "1 undecided, 15 not known yet"
    centre, low, high = group.found[0].difference
    # Student's t with 99 degrees of freedom: 1.984; a sample's deviation of 0.6 * sqrt(100 / 99)
    assert centre == pytest.approx(0.1) and high - centre == pytest.approx(1.984 * 0.6 / 99**0.5, rel=0.01)
    assert centre - low == pytest.approx(high - centre)


def drawn(monkeypatch, name, found, tmp_path):
    """The axes of a figure."""
    made = []
    monkeypatch.setattr(figures, "save", lambda figure, path: made.append(figure) or True)
    assert figures.FIGURES[name][-1](found, tmp_path / name)
    return made[0].axes


def test_a_point_is_drawn_under_the_name_of_its_method(monkeypatch, tmp_path):
    names = {
        "mcts-R4-6x6x5-mask_true": "MCTS, mask", "mcts-R4-6x6x5-mask_false": "MCTS, no mask",
        "random-R4-6x6x5": "random, feasible", "fcn4d-R4-s0-6x6x5-K1": "fcn4d (the paper's), K=1",
        "fcn4d_noclip-R4-s0-6x6x5-K1": "4D FCN, no clipping, K=1", "typical-R4-s0-6x6x5-K1": "typical, K=1",
    }  # fmt: skip
    found = {name: result(0.1 + 0.1 * number) for number, name in enumerate(names)}
    axes = drawn(monkeypatch, "rl_methods", found, tmp_path)[-1]
    looks = {text: handle[0] for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)}
    points = {(line.get_color(), line.get_marker()): line.get_ydata() for line in axes.lines if len(line.get_ydata())}
    assert {text: points[look.get_color(), look.get_marker()][0] for text, look in looks.items()} == pytest.approx(
        {text: 0.1 + 0.1 * number for number, text in enumerate(names.values())}
    )


@pytest.mark.parametrize(("episodes", "hollow"), [(19, True), (20, False)])
def test_a_point_of_few_episodes_is_hollow(monkeypatch, tmp_path, episodes, hollow):
    axes = drawn(monkeypatch, "rl_methods", {"random-R4-6x6x5": result(0.3, episodes)}, tmp_path)[-1]
    [point] = [line for line in axes.lines if len(line.get_ydata()) == 1 and line.get_marker() == "x"]
    assert (point.get_markerfacecolor() == "white") == hollow


def test_a_plan_may_turn_items():
    """Items of 2x1 side by side, all turned, in a tote so low that nothing collides."""
    env = PickPlaceEnv(tote_size=(4, 4, 1), items=Kinds([(2, 1, 1)]), num_envs=1, stream="test")

    def packer(size, turns):
        places = iter([(x, y) for x in range(4) for y in (0, 2)])
        return lambda w, d, h: (*place, 0, d, w) if (place := next(places, None)) else None

    assert placement_only.replay(env, packer) == (["executed"] * 8, 1.0, 1.0)


@pytest.mark.parametrize(("frames", "short"), [(49, True), (50, False)])
def test_a_point_is_pale_where_a_seed_had_less_than_half_of_its_training(frames, short):
    found = {"m-s0": result(0.5, training="a"), "m-s1": result(0.6, training="b")}
    found |= {"a": {"frames": 100, "frames_asked": 100}, "b": {"frames": frames, "frames_asked": 100}}
    assert figures.pooled(found, "m-s*")["short"] == short
