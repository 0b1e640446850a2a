"""Test the comparison: definitions, tables and verdicts."""

import re

import cells
import claims
import figures
import pytest
import results
import table
from hydra import compose, initialize_config_dir

from pickplace.runs.hydra_app import conf_dir

TRAININGS, EVALUATIONS = cells.read()


def test_cells_compose():
    """The cells that hold all words that any cell holds, numbers aside."""
    seen = set()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        for cell in [*TRAININGS.values(), *EVALUATIONS.values()]:
            words = {(cell.command, re.sub(r"=[\d_.,\[\]]+$", "", word)) for word in cell.overrides}
            if cell.command != "placement_only.py" and not words <= seen:
                stream = compose(cell.command.removeprefix("pickplace-"), list(cell.overrides)).evaluation.stream
                assert stream == ("validation" if cell.command == "pickplace-train" else "test")
                seen |= words


def test_an_entry_stands_for_every_combination_of_its_axes():
    entry = {"name": "m-R{R}-s{seed}", "training": "t-s{seed}", "R": [1, 4], "seed": [0], "tote": ["6x6x5"]}
    made = cells.expand({**entry, "set": "a=1"}, "pickplace-evaluate")
    assert [cell.name for cell in made] == ["m-R1-s0", "m-R4-s0"] and made[1].training == "t-s0"
    assert made[1].overrides == ("env.support=half", "env.rotations=4", "env.tote_size=[6,6,5]", "a=1")
    assert cells.expand({"name": "t-s{seed}", "seed": [3]}, "pickplace-train")[0].overrides[1:] == ("seed=3",)
    with pytest.raises(ValueError, match="gird"):
        cells.expand({"name": "m", "gird": [1]}, "pickplace-train")


def test_a_row_comes_back_from_its_table_as_it_was(tmp_path):
    result = {
        "planner": "policy", "planner_settings": {"candidates": 10}, "candidates": 10, "mask_at_decision": False,
        "env": {"bin_size": [5, 5, 1], "tote_size": [6, 6, 5], "rotations": 4}, "items": {"kinds": []}, "seed": 0,
        "episodes": 2, "occupancy": {"mean": 0.1 + 0.2, "ci95": [-0.1, 0.5], "min": 0.0}, "failures": {"stuck": 2},
        "latency_ms": {"p50": 2.0, "cpu_mean": 1.5}, "commit": "1234567e123",
    }  # fmt: skip
    row = table.result_row("m-R4-s0", result, training_seed=1, checkpoint=None)
    assert (row["mean"], row["low"], row["decision_clock"]) == (0.1 + 0.2, 0.0, "cpu_mean") and "settings" not in row
    table.update("results", [row, {"cell": "other", "method": "other"}], folder=tmp_path)
    assert table.read("results", tmp_path)["m-R4-s0"] == row
    table.update("results", [row | {"mean": 0.5}], drop=lambda found: found["cell"] == "other", folder=tmp_path)
    assert table.read("results", tmp_path) == {"m-R4-s0": row | {"mean": 0.5}}


def test_differences_are_paired_and_cover_the_seeds():
    played = {"a-s0": [0.5, 0.7, 0.6], "a-s1": [0.6, 0.8, 0.7], "b": [0.4, 0.6, 0.5]}
    played |= dict.fromkeys(("a-s0-x", "a-s1-x"), [0.5, 0.7])
    row = list(claims.difference("a-s*", "b", played).values())
    assert row == ["a-s*", "b", *(pytest.approx(value) for value in (0.15, 3, 0.1, 0.2)), 2, 0]
    same = claims.difference("a-s*", "a-s*-x", played)  # each seed against itself only
    assert (same["mean"], same["high"], same["episodes"]) == (pytest.approx(0.05), pytest.approx(0.1), 2)
    assert claims.difference("b", "0.4", played)["mean"] == pytest.approx(0.1)
    curves = {("a", 100): 0.3, ("a", 200): 0.6, ("a", 300): 1.0, ("b", 100): 0.1, ("b", 200): 0.2}
    points = [{"training": name, "frames": frames, "occupancy": value} for (name, frames), value in curves.items()]
    assert claims.learning_difference("a", "b", points)["mean"] == pytest.approx(0.4)  # at 200 frames, which both have


@pytest.mark.parametrize(("low", "high", "episodes", "height", "word"), [
    (0.02, 0.04, 100, 5, "yes"),
    (-0.01, 0.04, 100, 5, "undecided"),
    (0.02, 0.04, 19, 5, "undecided"),
    (-0.04, -0.02, 100, 4, "no"),
    (-0.04, -0.02, 100, 3, "undecided"),  # it lost, but was not trained to the end
    (0.02, 0.04, 100, 3, "yes"),  # it won although it was not
])  # fmt: skip
def test_a_verdict_needs_a_clear_interval_episodes_and_a_finished_training(low, high, episodes, height, word):
    row = {"mean": (low + high) / 2, "low": low, "high": high, "episodes": episodes, "seeds_a": 1, "seeds_b": 0}
    ours = {"mean": 0.5, "height_reached": height, "training_tote_height": 5}
    rows, found = {"a": ours, "b": {"mean": 0.4}}, {("a", "b"): row}
    assert claims.judge(claims.Comparison("a", ("b",)), rows, found).verdict == word
    below = claims.judge(claims.Comparison("a", ("b",), below=True), rows, found).verdict
    assert below == {"yes": "no", "no": "yes"}.get(word, word)


def test_a_gain_needs_both_intervals():
    row = {"mean": 0.3, "low": 0.29, "high": 0.31, "episodes": 100, "seeds_a": 1, "seeds_b": 0}
    wide = {**row, "mean": 0.1, "low": 0.0, "high": 0.2}
    found = {("a", "b"): row, ("c", "d"): wide}
    finding = claims.judge(claims.Comparison("a", ("b",), wide=claims.Comparison("c", ("d",))), {}, found)
    assert (finding.verdict, finding.low) == ("yes", pytest.approx(0.0995, abs=1e-3))


def test_the_best_rival_counts_and_what_is_not_there_is_said():
    rows = {"a": {"mean": 0.5}, "b": {"mean": 0.4}, "c": {"mean": 0.6}, "tried": {"attempted": "no memory"}}
    both = claims.Comparison("a", ("b", "c"))
    assert claims.rival(both, rows) == "c" and claims.rival(claims.Comparison("a", ("b", "later")), rows) is None
    assert claims.judge(both, rows, {}).verdict == "missing"
    assert claims.judge(claims.Comparison("a", ("tried",)), rows, {}).verdict == "attempted"


def test_every_claim_has_a_line_and_every_figure_is_drawn_without_results(tmp_path):
    lines = [line for beyond in (False, True) for line in results.claims_table({}, {}, beyond)[2:]]
    assert len(lines) == len(claims.read()) and all("missing" in line for line in lines)
    for name in figures.FIGURES:
        figures.draw(name, {}, [], tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 1000
