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
from pickplace.views.figures import failure_mix, figure_of, learning_curve, played_levels


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
    assert outside.index("The tote at its fullest") < outside.index("Learning curve")
    assert re.search(r"pre \{[^}]*white-space: pre-wrap", outside)  # long commands wrap
    assert "How training episodes ended" in outside and "Ended before" not in outside
    # The replay has the best and the worst episode, and opens at the end of the best.
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', text)[1])
    data = json.loads(zlib.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', inner)[1])))
    occupancy = [episode["occupancy"] for episode in data["episodes"]]
    worst = re.search(r"<b>([\d.]+)</b><span>its worst episode", text)[1]
    assert occupancy[0] >= rows[-1]["eval/occupancy"] >= occupancy[-1] and len(occupancy) in (1, 2)
    assert f"{occupancy[-1]:.4f}" == worst and data["step"] == len(data["episodes"][0]["moves"]) > 0


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Draws a table as a learning curve, and returns the figure."""

    def draw(rows, *arguments):
        made, metrics = [], tmp_path / "metrics.csv"
        monkeypatch.setattr(figures, "save", lambda figure, path: made.append(figure))
        metrics.write_text("\n".join([*rows, ""]))
        learning_curve(metrics, tmp_path / "figure.png", *arguments)
        return made[0]

    return draw


MIX = ("frames", "train/failure_stuck", "train/failure_overflow", "train/episodes")


@pytest.mark.parametrize(
    "rows", [[], [{"frames": 128}], [{"frames": 128, **dict(zip(MIX[1:], (1.0, 0.0, 3), strict=True))}]]
)
def test_reasons_for_the_end_are_drawn_where_there_are_several(rows):
    assert not failure_mix(rows)


def test_failures_are_shares_of_the_episodes_and_not_of_the_batches(monkeypatch):
    """Of 200 batches two are averaged: one episode that was stuck, and three that were not."""
    made = []
    monkeypatch.setattr(figures, "figure_of", lambda *size: made.append(figure_of(*size)) or made[-1])
    rows = [dict(zip(MIX, (2 * i + k, 1 - k, k, 1 + 2 * k), strict=True)) for i in range(100) for k in (0, 1)]
    assert failure_mix(rows).startswith(b"\x89PNG")
    lowest, upper = made[0].axes[0].collections
    assert [lowest.get_label(), upper.get_label()] == ["stuck", "overflow"]
    edge = lowest.get_paths()[0].vertices
    assert edge[edge[:, 0] == 100, 1].max() == pytest.approx(0.25)


VALIDATIONS = ["frames,eval/occupancy,eval/ci95_low,eval/ci95_high", "100,0.5,0.4,0.8", "200,0.6,0.5,0.7"]


def test_the_learning_curve_shows_intervals_and_its_axes_fit_them(drawn):
    figure = drawn(VALIDATIONS, ("level", 1), "perhaps luck")
    (axes,) = figure.axes
    [bars] = axes.collections
    assert np.allclose(bars.get_segments()[0], [[100, 0.4], [100, 0.8]])
    low, high = axes.get_ylim()
    assert 0.35 < low < 0.4 and 0.8 < high < 0.85
    figure.draw_without_rendering()
    legend = axes.get_legend()
    assert not legend.get_window_extent().overlaps(axes.get_window_extent())  # it covers no data
    assert "end: perhaps luck" in [text.get_text() for text in legend.get_texts()]


def test_levels_are_drawn_by_their_occupancy(drawn):
    """Of a list of three levels the last is never played; a level that is not played in a batch stays white."""
    head = "frames,curriculum/occupancy_at_1,curriculum/occupancy_at_2"
    _, lower, _ = drawn([head, "100,0.5,", "200,0.7,0.25"], ("level", 3)).axes
    assert lower.collections[0].get_array().tolist() == [[0.5, 0.7], [None, 0.25], [None, None]]
    assert lower.get_ylabel() == "level" and lower.get_ylim() == (0.5, 3.5)
    assert played_levels([{"curriculum/occupancy_at_12": 1, "curriculum/occupancy_at_best": 1}]) == [12]
    assert len(drawn([head, "100,,0.5"], ("level", 2)).axes) == 1  # without a curriculum there is nothing to see


def test_the_occupancy_of_a_height_is_that_of_its_last_batches():
    rows = [{"frames": i, "curriculum/occupancy_at_2": i / 100} for i in range(1, 51)]
    assert "<td>0.4050</td><td>1 to 50</td>" in level_table(rows, "level")  # the mean of 0.31 to 0.50
    listed = level_table([{"frames": 1, "curriculum/occupancy_at_1": 1.0}], "level", [{"rotations": 1}, {}])
    assert "<td>1 to 1</td><td>rotations: 1</td>" in listed
