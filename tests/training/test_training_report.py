"""The report of a training run agrees with the run's own files, and its figures with their tables."""

import base64
import html
import json
import re
import zlib

import numpy as np
import pytest

from pickplace.runs.loggers import read_csv
from pickplace.training.report import level_table
from pickplace.views import figures
from pickplace.views.figures import failure_mix, figure_of, learning_curve

MIX = "frames,train/failure_stuck,train/failure_overflow,train/episodes"


@pytest.fixture
def run_dir(run, tmp_path):
    """A small run without a mask, so that episodes end in many ways, in a folder whose name is hard to quote."""
    folder = tmp_path / "run {{title}} <1>"
    settings = ["experiment=smoke", "algo.mask_infeasible=false", "seed=3", "threads=1"]
    assert run("train", *settings, f"hydra.run.dir='{folder}'")[0] == 0
    return folder


def test_a_report_agrees_with_the_run(run_dir):
    text = (run_dir / "report.html").read_text()
    rows = [row for row in read_csv(run_dir / "metrics.csv") if "eval/occupancy" in row]
    assert len(rows) == 2
    outside = re.sub(r'srcdoc="[^"]*"', "", text)
    for row in rows:
        assert f"<td>{row['frames']:,}</td><td>{row['eval/occupancy']:.4f}</td>" in outside
    assert f"<b>{max(row['eval/occupancy'] for row in rows):.4f}</b>" in outside
    assert "pickplace-train experiment=smoke algo.mask_infeasible=false seed=3" in outside
    assert "mask_infeasible: false" in outside and "torchrl:" in outside and "mask in training: no" in outside
    assert not re.search(r'(src|href)="(?!data:)', outside) and not re.findall(r"\{\{\w+\}\}", outside)
    # The replay has the worst and the best episode.
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', text)[1])
    data = json.loads(zlib.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', inner)[1])))
    occupancy = [episode["occupancy"] for episode in data["episodes"]]
    worst = re.search(r"<b>([\d.]+)</b><span>its worst episode", text)[1]
    assert occupancy == sorted(occupancy) and f"{occupancy[0]:.4f}" == worst and len(occupancy) in (1, 2)
    assert occupancy[0] <= rows[-1]["eval/occupancy"] <= occupancy[-1]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn."""
    made = []
    monkeypatch.setattr(figures, "figure_of", lambda *size: made.append(figure_of(*size)) or made[-1])
    return made


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "table", ["frames\n", "frames,train/failure_stuck,train/episodes\n128,,0\n", f"{MIX}\n128,1.0,0.0,3\n"]
)
def test_failures_of_hardly_any_batch(table, tmp_path):
    (tmp_path / "metrics.csv").write_text(table)
    failure_mix(tmp_path / "metrics.csv", tmp_path / "mix.png")
    assert (tmp_path / "mix.png").read_bytes().startswith(b"\x89PNG")


def test_failures_are_shares_of_the_episodes_and_not_of_the_batches(drawn, tmp_path):
    """Of 200 batches two are averaged: one episode that was stuck, and three that were not."""
    rows = [f"{2 * i + k},{1 - k},{k},{1 + 2 * k}" for i in range(100) for k in (0, 1)]
    (tmp_path / "metrics.csv").write_text("\n".join([MIX, *rows, ""]))
    failure_mix(tmp_path / "metrics.csv", tmp_path / "mix.png")
    lowest, upper = drawn[0].axes[0].collections  # in the order of the failures
    assert [lowest.get_label(), upper.get_label()] == ["stuck", "overflow"]
    edge = lowest.get_paths()[0].vertices
    assert edge[edge[:, 0] == 100, 1].max() == pytest.approx(0.25)


def test_the_bar_of_a_validation_is_its_interval(drawn, tmp_path):
    (tmp_path / "metrics.csv").write_text("frames,eval/occupancy,eval/ci95_low,eval/ci95_high\n100,0.5,0.4,0.8\n")
    learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    [bar] = drawn[0].axes[0].collections
    assert np.allclose(bar.get_segments()[0], [[100, 0.4], [100, 0.8]])


def test_the_occupancy_of_a_height_is_that_of_its_last_batches():
    rows = [{"frames": i, "curriculum/occupancy_at_2": i / 100} for i in range(1, 51)]
    assert "<td>0.4050</td><td>1 to 50</td>" in level_table(rows)  # the mean of 0.31 to 0.50
