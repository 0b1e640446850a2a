"""Figures and tables: exact visibility, small and odd input."""

import numpy as np
import pytest

from pickplace import CellSpec, Failure
from pickplace.evaluation.artifacts import evaluation_table
from pickplace.views.figures import FAILURES, learning_curve
from pickplace.views.recording import Move, Recording
from pickplace.views.replay import picture
from pickplace.views.scene import draw_scene, far_to_near, item_colours, visible_triangles


@pytest.mark.parametrize("seed", range(2))
def test_visible_triangles_against_lines_of_sight(seed):
    size = (5, 4, 6)
    rng, boxes, taken = np.random.default_rng(seed), [], np.zeros(size, dtype=bool)
    for corner, sides in zip(rng.integers(0, size, (40, 3)), rng.integers(1, 4, (40, 3)), strict=True):
        space = tuple(slice(c, c + s) for c, s in zip(corner, sides, strict=True))
        if (corner + sides <= size).all() and not taken[space].any():  # hanging in the air or not
            taken[space] = True
            boxes.append((*corner.tolist(), *sides.tolist()))
    expected = {}
    reach = range(-max(size), max(size) + 1)
    for i in reach:
        for j in reach:
            for triangle in (((i, j), (i, j + 1), (i + 1, j + 1)), ((i, j), (i + 1, j), (i + 1, j + 1))):
                # The line of sight through the triangle's middle, (a + t, b + t, t): of the boxes it meets, the one
                # that it leaves last, and the coordinate that it leaves it by.
                origin = np.array([*np.mean(triangle, axis=0), 0.0])
                hits = []
                for number, box in enumerate(boxes):
                    low = np.array(box[:3]) - origin
                    high = low + box[3:]
                    if low.max() < high.min():
                        hits.append((high.min(), number, (1, 2, 0)[high.argmin()]))  # FACES: z, x, y
                if hits:
                    expected[tuple(sorted(triangle))] = max(hits)[1:]
    assert len(boxes) > 5
    assert visible_triangles(boxes) == expected


def recording_of(boxes, size, failure=Failure.STUCK):
    """An episode that placed these boxes and ended so."""
    moves = [Move((0, 0, w, d, h), (0, 0), (0, 0), 0, (x, y, w, d), z, Failure.NONE) for x, y, z, w, d, h in boxes]
    return Recording(0, size[2], moves, failure)


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


@pytest.mark.parametrize(("x", "y"), [(2, 0), (0, 3)])
def test_the_picture_in_3d_shows_items_where_they_lie(x, y):
    """The middle of a cube is half a cell above that of the floor below it."""
    boxes, size = [(x, y, 0, 1, 1, 1)], (3, 4, 1)
    figure = draw_scene(recording_of(boxes, size), CellSpec(tote_size=size), item_colours(boxes))
    tote, cube = (part for part in figure.axes[0].collections if type(part).__name__ == "PolyCollection")
    corner, along_x, _, along_y = tote.get_paths()[0].vertices[:4]
    floor = corner + (along_x - corner) * (x + 0.5) / 3 + (along_y - corner) * (y + 0.5) / 4
    middle = np.mean([path.vertices[:3] for path in cube.get_paths()], axis=(0, 1))
    assert middle == pytest.approx(floor + [0, 0.5])


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


@pytest.mark.parametrize("seed", range(3))
def test_nearer_boxes_are_drawn_over_farther_ones(seed):
    """On lines of sight through the parts of a block that was cut at random, the last one drawn is the one seen."""
    draw, boxes = np.random.default_rng(seed), [np.array([[0.0, 0, 0], [4, 3, 2]])]  # low and high corner
    for _ in range(20):
        low, high = boxes.pop(draw.integers(len(boxes)))
        axis = draw.integers(3)
        cut = draw.uniform(low[axis], high[axis])
        halves = np.array([[low, high], [low, high]])
        halves[0, 1, axis] = halves[1, 0, axis] = cut
        boxes += [*halves]
    low, high = np.array(boxes)[draw.random(len(boxes)) < 0.8].transpose(1, 0, 2)
    order = far_to_near(low, high - low)
    assert sorted(order) == list(range(len(low)))
    met = 0
    for origin in np.pad(draw.uniform(-2, 4, (2000, 2)), ((0, 0), (0, 1))):  # the line (a + t, b + t, t)
        begin, end = (low - origin).max(1), (high - origin).min(1)
        hit = np.nonzero(begin < end)[0]
        if len(hit) > 1:
            met += 1
            assert max(hit, key=order.index) == max(hit, key=lambda number: end[number])
    assert met > 100
