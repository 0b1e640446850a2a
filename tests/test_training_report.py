"""The report of a training run says what the run's own files say."""

import base64
import html
import json
import os
import re
import subprocess
import sys
import zlib

import pytest

from pickplace.metrics import read_csv
from pickplace.report import failure_mix


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A small run without a mask, so that episodes end in many ways."""
    folder = tmp_path_factory.mktemp("report") / "run {{title}} <1>"
    command = [
        sys.executable, "-m", "pickplace.train", "experiment=smoke", "algo.mask_infeasible=false", "seed=3",
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
    assert "python -m pickplace.train experiment=smoke algo.mask_infeasible=false seed=3" in outside
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
