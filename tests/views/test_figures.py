"""Figures and tables: which items are seen, small and odd input."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from pickplace import CellSpec, Failure
from pickplace.evaluation.artifacts import evaluation_table
from pickplace.views.figures import FAILURES, learning_curve
from pickplace.views.recording import Move, PlacedItem, Recording
from pickplace.views.replay import picture
from pickplace.views.scene import FACES, draw_scene, item_colours, kind_of


def recording_of(boxes, size, failure=Failure.STUCK):
    """An episode that placed these boxes and ended so."""
    moves = [Move((0, 0, w, d, h), (0, 0), (0, 0), 0, (x, y, w, d), z, Failure.NONE) for x, y, z, w, d, h in boxes]
    return Recording(0, size[2], moves, failure)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_picture_of_a_large_tote_and_of_many_kinds(tmp_path):
    small = [(3 * i, 3 * j, 3 * k, i + 1, j + 1, k + 1) for i in range(3) for j in range(3) for k in range(3)]
    large = [(x, y, z, 2, 2, 1) for z in range(10) for x in range(0, 30, 2) for y in range(0, 28, 2)]
    for boxes, size in ((small, (9, 9, 9)), (large, (30, 30, 10))):
        picture(recording_of(boxes, size), CellSpec(tote_size=size), tmp_path / "tote.png")
        assert (tmp_path / "tote.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("depth", "failure", "ending"), [
    (1, Failure.STUCK, "50.0% full, 1 items placed. This item fits nowhere any more."),
    (2, Failure.STUCK, "100.0% full, 1 items placed. The tote is full."),
    (1, Failure.ITEM_COLLISION, "The gripper would hit an item in the tote."),
    (1, Failure.NONE, "The item stream is over."),
])  # fmt: skip
def test_caption(depth, failure, ending):
    boxes = [(0, 0, 0, 2, depth, 1)]
    cell, recording = CellSpec(tote_size=(2, 2, 1)), recording_of(boxes, (2, 2, 1), failure)
    caption = draw_scene(recording, cell, item_colours(boxes)).get_suptitle()
    assert caption.startswith("2x2x1 tote") and ending in caption
    before = draw_scene(recording, cell, item_colours(boxes), moves=0)
    assert before.get_suptitle() == "2x2x1 tote, 0.0% full, 0 items placed"


def test_sizes_are_in_cells():
    boxes, size = [(0, 0, 0, 2, 1, 3)], (3, 4, 5)
    figure = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size, height_unit=0.5), item_colours(boxes))
    assert figure.get_suptitle().startswith("3x4x2.5 tote")
    assert [text.get_text() for text in figure.legends[0].texts] == ["1x2x1.5"]
    assert figure.axes[2].get_ylabel() == "height (units of 0.5 cells)"


def test_the_height_map_lies_as_the_tote():
    """x to the right, y upwards."""
    boxes, size = [(0, 0, 0, 2, 1, 1), (2, 3, 0, 1, 1, 2)], (3, 4, 2)
    plan = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size), item_colours(boxes)).axes[1]
    shown = np.zeros((3, 4), dtype=int)
    for text in plan.texts:
        shown[tuple(int(at) for at in text.get_position())] = int(text.get_text())
    expected = [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 2]]
    assert shown.tolist() == expected
    assert np.asarray(plan.images[0].get_array()).T.tolist() == expected and plan.images[0].origin == "lower"
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("x (cells)", "y (cells)")


def test_the_height_map_of_a_full_tote_shows_the_items_on_top():
    """The first one is covered; the lines are the sides of the other two."""
    boxes, size = [(0, 0, 0, 3, 2, 1), (0, 0, 1, 1, 2, 1), (1, 0, 1, 2, 2, 1)], (3, 2, 2)
    plan = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size), item_colours(boxes)).axes[1]
    [sides] = plan.collections
    assert [path.vertices.tolist() for path in sides.get_paths()] == [[[0.5, y - 0.5], [0.5, y + 0.5]] for y in (0, 1)]


@pytest.mark.parametrize(("x", "y"), [(2, 0), (0, 3)])
def test_the_picture_in_3d_shows_items_where_they_lie(x, y):
    """The middle of a cube is half a cell above that of the floor below it."""
    boxes, size = [(x, y, 0, 1, 1, 1)], (3, 4, 1)
    figure = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size), item_colours(boxes))
    tote, cube = (part for part in figure.axes[0].collections if type(part).__name__ == "PolyCollection")
    faces = [path.vertices[:4] for path, fill in zip(cube.get_paths(), cube.get_facecolors(), strict=True) if fill[3]]
    corner, along_x, _, along_y = tote.get_paths()[0].vertices[:4]
    floor = corner + (along_x - corner) * (x + 0.5) / 3 + (along_y - corner) * (y + 0.5) / 4
    middle = np.mean(faces, axis=(0, 1))
    assert middle == pytest.approx(floor + [0, 0.5])


def count_lines_through_several(items, size, unit, draw):
    """Check on lines of sight that the last face drawn is the nearest one; return how many pass several items."""
    colours, deep = item_colours(items), size[1]
    cell = CellSpec(tote_size=size, height_unit=unit)
    drawn = draw_scene(recording_of(items, size), cell, colours).axes[0].collections[-1]
    faces = [(path, fill) for path, fill in zip(drawn.get_paths(), drawn.get_facecolors(), strict=True) if fill[3]]
    met = 0
    for a, b in draw.uniform(-6, 5, (400, 2)):  # the line (a + t, b + t, t), with y turned around
        hits = []
        for x, y, z, w, d, h in items:
            low = np.array([x - a, deep - y - d - b, z * unit])
            high = low + (w, d, h * unit)
            if low.max() < high.min():  # it leaves the item at `high.min()`, by one of the three faces
                light = [FACES[face][1] for face in (1, 2, 0)][high.argmin()]
                hits.append((high.min(), np.multiply(to_rgb(colours[kind_of(PlacedItem(x, y, z, w, d, h))]), light)))
        point = ((a - b) * 3**0.5 / 2, -(a + b) / 2)
        shown = [fill[:3] for path, fill in faces if path.contains_point(point)]
        assert bool(shown) == bool(hits)
        if hits:
            met += len(hits) > 1
            assert shown[-1] == pytest.approx(max(hits, key=lambda hit: hit[0])[1])
    return met


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("unit", [1, 0.4])
def test_the_picture_in_3d_shows_the_nearest_item(seed, unit):
    """Of items that hang in the air or not."""
    size = (5, 4, 6)
    draw, items, taken = np.random.default_rng(seed), [], np.zeros(size, dtype=bool)
    for corner, sides in zip(draw.integers(0, size, (40, 3)), draw.integers(1, 4, (40, 3)), strict=True):
        space = tuple(slice(c, c + s) for c, s in zip(corner, sides, strict=True))
        if (corner + sides <= size).all() and not taken[space].any():
            taken[space] = True
            items.append(PlacedItem(*corner.tolist(), *sides.tolist()))
    assert len(items) > 5 and count_lines_through_several(items, size, unit, draw) > 20


def test_the_picture_in_3d_shows_items_that_hide_one_another_in_a_circle():
    """Each hides a part of the next one, so that in no order of whole items the nearest is drawn last."""
    seen = [(0, 0, 1, 3, 1, 1), (1, 0, 0, 1, 3, 1), (0, 1, 0, 1, 1, 3)]  # with y turned around
    items = [PlacedItem(x, 3 - y - d, z, w, d, h) for x, y, z, w, d, h in seen]
    assert count_lines_through_several(items, (3, 3, 3), 1, np.random.default_rng(0)) > 10


def test_the_picture_takes_no_longer_on_a_finer_grid():
    counts = []
    for scale in (1, 25):
        boxes = [(0, 0, 0, 2, 1, 2), (0, 1, 0, 1, 2, 1), (2, 0, 0, 1, 1, 1)]
        boxes, size = [tuple(scale * side for side in box) for box in boxes], (4 * scale, 3 * scale, 20 * scale)
        figure = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size), item_colours(boxes))
        bar = figure.axes[2].yaxis
        counts.append(len(figure.axes[0].collections[-1].get_paths()))
        assert len(bar.get_ticklocs()) < 20 and not len(bar.get_ticklocs(minor=True))
    assert counts[0] == counts[1] < 60


CURVES = {
    "header only": "frames\n",
    "one row, nothing ended": "frames,time/fps\n128,900\n",
    "interval": "frames,eval/occupancy,eval/ci95_low,eval/ci95_high\n128,,,\n256,0.5,0.4,0.6\n384,1.0,1.0000001,1.0\n",
    "cut short": "frames,train/occupancy,curriculum/level\n128,0.4,2\n256,0.",
}


@pytest.mark.parametrize("rows", CURVES.values(), ids=CURVES)
@pytest.mark.filterwarnings("error")
def test_learning_curve(rows, tmp_path):
    assert set(FAILURES) == {failure.name.lower() for failure in Failure}  # the colours of its areas
    metrics, path = tmp_path / "metrics.csv", tmp_path / "curve.png"
    metrics.write_text(rows)
    learning_curve(metrics, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF") and "<svg" in path.with_suffix(".svg").read_text()


RESULT = {
    "planner": "policy", "env": {"tote_size": [6, 6, 5], "rotations": 4}, "stream": "test", "episodes": 4, "seed": 1,
    "occupancy": {"mean": 0.97777, "ci95": [0.97, 0.985], "min": 0.9722}, "items_placed": 76.5,
    "failures": {"stuck": 3, "unstable": 1}, "feasible_action_share": 0.0925, "latency_ms": {"p50": 1.24, "p95": 1.44},
    "checkpoint": "run/checkpoints/best", "trained": {"frames": 1_200_000, "seed": 3}, "warm_start": "joint_dbl",
    "mask_in_training": True, "mask_at_decision": False, "candidates": 10,
}  # fmt: skip


def test_a_name_ends_no_cell_of_a_table():
    result = {**RESULT, "paired_difference": {"against": "a|b<script>", "mean": 0.1, "ci95": [0, 0.2]}}
    assert r"| minus a\|b\<script> | " in evaluation_table(result)


def test_evaluation_table():
    head, _, *lines = evaluation_table(RESULT).splitlines()
    rows = dict([cell.strip() for cell in line.strip("|").split("|")] for line in [head, *lines])
    assert rows == {
        "planner": "policy", "tote, rotations": "6x6x5, R=4", "episodes": "4 of the test stream, seed 1",
        "occupancy": "0.9778 (95% interval 0.9700 to 0.9850), least 0.9722", "items placed": "76.5 an episode",
        "episodes ended by": "stuck 3, unstable 1", "feasible actions": "9.25% of all, mean over decisions",
        "one decision": "1.2 ms (median), 1.4 ms (95th percentile)", "warm start": "imitated joint_dbl",
        "mask; candidates K": "in training yes, at decision no; 10",
        "checkpoint": "run/checkpoints/best (1,200,000 frames, seed 3)",
    }  # fmt: skip
