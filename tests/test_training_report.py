"""The report of a training run says what the run's own files say."""

import base64
import html
import json
import os
import re
import subprocess
import sys
import zlib

import numpy as np
import pytest

from pickplace.runs.loggers import read_csv
from pickplace.training.report import _levels
from pickplace.views.figures import failure_mix, figure_of, learning_curve


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A small run without a mask, so that episodes end in many ways."""
    folder = tmp_path_factory.mktemp("report") / "run {{title}} <1>"
    command = [
        sys.executable, "-m", "pickplace.training.train", "experiment=smoke", "algo.mask_infeasible=false", "seed=3",
        f"hydra.run.dir='{folder}'",
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    return folder


def test_report_agrees_with_the_metrics(run_dir):
    text = (run_dir / "report.html").read_text()
    rows = [row for row in read_csv(run_dir / "metrics.csv") if "eval/occupancy" in row]
    assert len(rows) == 2
    outside = re.sub(r'srcdoc="[^"]*"', "", text)
    for row in rows:
        assert f"<td>{row['frames']:,}</td><td>{row['eval/occupancy']:.4f}</td>" in outside
    assert f"<b>{max(row['eval/occupancy'] for row in rows):.4f}</b>" in outside
    assert "pickplace-train experiment=smoke algo.mask_infeasible=false seed=3" in outside
    assert "mask_infeasible: false" in outside and "torchrl:" in outside and "mask in training: no" in outside
    assert not re.search(r'(src|href)="(?!data:)', outside)
    assert not re.findall(r"\{\{\w+\}\}", outside)


def test_report_replays_the_worst_and_the_best_episode(run_dir):
    text = (run_dir / "report.html").read_text()
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', text)[1])
    data = json.loads(zlib.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', inner)[1])))
    occupancy = [episode["occupancy"] for episode in data["episodes"]]
    worst = re.search(r"<b>([\d.]+)</b><span>its worst episode", text)[1]
    assert occupancy == sorted(occupancy) and f"{occupancy[0]:.4f}" == worst
    mean = read_csv(run_dir / "metrics.csv")[-1]["eval/occupancy"]
    assert occupancy[0] <= mean <= occupancy[-1] and len(occupancy) in (1, 2)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "table",
    [
        "frames\n",
        "frames,train/failure_stuck,train/episodes\n128,,0\n",
        "frames,train/failure_stuck,train/failure_overflow,train/episodes\n128,1.0,0.0,3\n",
        "frames,train/failure_stuck,train/failure_overflow,train/episodes\n"
        + "".join(f"{i},{i / 999},{1 - i / 999},{i % 3}\n" for i in range(1, 999)),
    ],
)
def test_failure_mix(table, tmp_path):
    (tmp_path / "metrics.csv").write_text(table)
    failure_mix(tmp_path / "metrics.csv", tmp_path / "mix.png")
    assert (tmp_path / "mix.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn."""
    figures = []
    monkeypatch.setattr(
        "pickplace.views.figures.figure_of", lambda *size: figures.append(figure_of(*size)) or figures[-1]
    )
    return figures


def test_failures_are_shares_of_the_episodes_and_not_of_the_batches(drawn, tmp_path):
    """Of 200 batches two are averaged: one episode that was stuck, and three that were not."""
    rows = [f"{2 * i + k},{1 - k},{k},{1 + 2 * k}" for i in range(100) for k in (0, 1)]
    head = "frames,train/failure_stuck,train/failure_overflow,train/episodes"
    (tmp_path / "metrics.csv").write_text("\n".join([head, *rows, ""]))
    failure_mix(tmp_path / "metrics.csv", tmp_path / "mix.png")
    lowest, upper = drawn[0].axes[0].collections  # in the order of the failures
    assert [lowest.get_label(), upper.get_label()] == ["stuck", "overflow"]
    edge = lowest.get_paths()[0].vertices
    assert edge[edge[:, 0] == 100, 1].max() == pytest.approx(0.25)


def test_a_validation_s_bar_is_its_interval(drawn, tmp_path):
    table = "frames,eval/occupancy,eval/ci95_low,eval/ci95_high\n100,0.5,0.4,0.8\n"
    (tmp_path / "metrics.csv").write_text(table)
    learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png")
    [bar] = drawn[0].axes[0].collections
    assert np.allclose(bar.get_segments()[0], [[100, 0.4], [100, 0.8]])


def test_a_height_s_occupancy_is_that_of_its_last_batches():
    rows = [{"frames": i, "curriculum/occupancy_at_2": i / 100} for i in range(1, 51)]
    assert "<td>0.4050</td><td>1 to 50</td>" in _levels(rows)  # the mean of 0.31 to 0.50
