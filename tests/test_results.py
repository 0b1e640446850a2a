"""The script behind docs/results.md: the page agrees with its data, and an evaluation becomes a row."""

import json

import pytest
import results
from results import RESULTS, TABLES, add, occupancy_table, pooled, read


def rows_of(kind):
    return {row["cell"]: row for row in read() if row["kind"] == kind}


def test_the_page_has_the_tables_of_its_data():
    page, found = results.PAGE.read_text(), rows_of("evaluation")
    for name, table in TABLES.items():
        lines = "\n".join(occupancy_table(table, found))
        assert f"<!-- {name}: written by make results -->\n\n{lines}\n\n<!-- end -->" in page
    for name in results.FIGURES:
        assert f"(results/{name}.png)" in page and (RESULTS / f"{name}.png").is_file()


def test_a_mean_over_seeds_covers_their_intervals():
    row = {"low": 0.4, "high": 0.6, "episodes": 100, "height_reached": 5, "training_tote_height": 5}
    found = {"a-s0": {**row, "mean": 0.5}, "a-s2": {**row, "mean": 0.7, "high": 0.8, "episodes": 10}}
    found["a-s1"] = {"attempted": "no memory"}
    mean = pooled("a-s*", found)
    assert (mean["mean"], mean["low"], mean["high"]) == (pytest.approx(0.6), 0.4, 0.8)
    assert (mean["episodes"], mean["untrained"]) == (10, False)
    assert pooled(["b-s*", "a-s0"], found)["mean"] == 0.5 and pooled("b", found) is None
    found["a-s2"]["height_reached"] = 3
    assert pooled("a-s*", found)["untrained"]


def test_an_evaluation_becomes_a_row(tmp_path, monkeypatch):
    """A newer evaluation of the same name replaces the row."""
    table, run = tmp_path / "paper.csv", tmp_path / "run"
    table.write_text(results.TABLE.read_text().splitlines()[0] + "\nevaluation,other\n")
    monkeypatch.setattr(results, "TABLE", table)
    (run / "checkpoints" / "best").mkdir(parents=True)
    metrics = "frames,eval/occupancy,curriculum/level\n128,,2\n256,0.5,3\n"
    (run / "metrics.csv").write_text(metrics)
    result = {
        "planner": "policy", "planner_settings": {"candidates": 10}, "candidates": 10, "mask_at_decision": False,
        "checkpoint": str(run / "checkpoints" / "best"), "trained": {"seed": 2},
        "env": {"bin_size": [5, 5, 1], "tote_size": [6, 6, 5], "rotations": 4}, "items_placed": 3.5, "episodes": 2,
        "occupancy": {"mean": 0.25, "ci95": [0.0, 0.5], "min": 0.125}, "failures": {"stuck": 1, "overflow": 1},
        "feasible_action_share": 0.1, "latency_ms": None, "commit": "1234567e12",
        "paired_difference": {"against": "random", "mean": 0.1, "ci95": [0.0, 0.2]},
    }  # fmt: skip
    for mean in (0.25, 0.5):
        result["occupancy"]["mean"] = mean
        (tmp_path / "evaluation.json").write_text(json.dumps(result))
        add("m-R{R}-s{seed}-{tote}-K{K}", tmp_path / "evaluation.json")
    rows = read()
    assert [row["kind"] for row in rows] == ["evaluation", "evaluation", "validation", "difference"]
    row = rows[1]
    assert (row["cell"], row["method"], row["training"]) == ("m-R4-s2-6x6x5-K10", "m", "m-R4-s2")
    assert (row["mean"], row["high"], row["height_reached"], row["endings"]) == (0.5, 0.5, 3, "stuck=1 overflow=1")
    assert (rows[2]["cell"], rows[2]["frames"], rows[2]["mean"]) == ("m-R4-s2", 256, 0.5)
    assert (rows[3]["versus"], rows[3]["low"], rows[3]["high"]) == ("random", 0, 0.2)
