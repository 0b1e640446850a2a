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


def test_a_report_agrees_with_the_run(run, tmp_path):
    """Without a mask, so that episodes end in many ways, in a folder whose name is hard to quote."""
    folder = tmp_path / "run {{title}} <1>"
    settings = ["experiment=smoke", "model.mask_infeasible=false", "seed=3", "threads=1"]
    assert run("train", *settings, f"hydra.run.dir='{folder}'")[0] == 0
    text = (folder / "report.html").read_text()
    rows = [row for row in read_csv(folder / "metrics.csv") if "eval/occupancy" in row]
    assert len(rows) == 2
    outside = re.sub(r'srcdoc="[^"]*"', "", text)
    for row in rows:
        assert f"<td>{row['frames']:,}</td><td>{row['eval/occupancy']:.4f}</td>" in outside
    assert f"<b>{max(row['eval/occupancy'] for row in rows):.4f}</b>" in outside
    for part in (f"pickplace-train {' '.join(settings[:3])}", "mask_infeasible: false", "torchrl:"):
        assert part in outside
    assert not re.search(r'(src|href)="(?!data:)', outside) and not re.findall(r"\{\{\w+\}\}", outside)
    # The replay has the worst and the best episode.
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', text)[1])
    data = json.loads(zlib.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', inner)[1])))
    occupancy = [episode["occupancy"] for episode in data["episodes"]]
    worst = re.search(r"<b>([\d.]+)</b><span>its worst episode", text)[1]
    assert occupancy == sorted(occupancy) and f"{occupancy[0]:.4f}" == worst and len(occupancy) in (1, 2)
    assert occupancy[0] <= rows[-1]["eval/occupancy"] <= occupancy[-1]


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Draws a table as a figure, and returns its first axes' collections."""

    def draw(figure, *rows):
        made, metrics = [], tmp_path / "metrics.csv"
        monkeypatch.setattr(figures, "figure_of", lambda *size: made.append(figure_of(*size)) or made[-1])
        metrics.write_text("\n".join([*rows, ""]))
        figure(metrics, tmp_path / "figure.png")
        assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
        return list(made[0].axes[0].collections)

    return draw


MIX = "frames,train/failure_stuck,train/failure_overflow,train/episodes"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [["frames"], [MIX, "128,,,0"], [MIX, "128,1.0,0.0,3"]])
def test_failures_of_hardly_any_batch(drawn, rows):
    assert len(drawn(failure_mix, *rows)) <= 1


def test_failures_are_shares_of_the_episodes_and_not_of_the_batches(drawn):
    """Of 200 batches two are averaged: one episode that was stuck, and three that were not."""
    lowest, upper = drawn(
        failure_mix, MIX, *(f"{2 * i + k},{1 - k},{k},{1 + 2 * k}" for i in range(100) for k in (0, 1))
    )
    assert [lowest.get_label(), upper.get_label()] == ["stuck", "overflow"]
    edge = lowest.get_paths()[0].vertices
    assert edge[edge[:, 0] == 100, 1].max() == pytest.approx(0.25)


def test_the_bar_of_a_validation_is_its_interval(drawn):
    [bar] = drawn(learning_curve, "frames,eval/occupancy,eval/ci95_low,eval/ci95_high", "100,0.5,0.4,0.8")
    assert np.allclose(bar.get_segments()[0], [[100, 0.4], [100, 0.8]])


def test_the_occupancy_of_a_height_is_that_of_its_last_batches():
    rows = [{"frames": i, "curriculum/occupancy_at_2": i / 100} for i in range(1, 51)]
    assert "<td>0.4050</td><td>1 to 50</td>" in level_table(rows, "level")  # the mean of 0.31 to 0.50
