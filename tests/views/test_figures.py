"""Figures and tables: exact visibility, small and odd input, and no matplotlib before it is needed."""

import subprocess
import sys

import numpy as np
import pytest

from pickplace.task.geometry import Failure, Rules
from pickplace.views import figures as report
from pickplace.views import replay
from pickplace.views.replay import Move, Recording


def random_boxes(rng, size, count):
    """Boxes on a grid of this size that do not overlap, hanging in the air or not."""
    taken, boxes = np.zeros(size, dtype=bool), []
    for _ in range(count):
        sides = rng.integers(1, 4, 3)
        corner = rng.integers(0, size)
        space = tuple(slice(c, c + s) for c, s in zip(corner, sides, strict=True))
        if (corner + sides <= size).all() and not taken[space].any():
            taken[space] = True
            boxes.append((*corner.tolist(), *sides.tolist()))
    return boxes


@pytest.mark.parametrize("seed", range(5))
def test_visible_triangles_against_lines_of_sight(seed):
    size = (5, 4, 6)
    boxes = random_boxes(np.random.default_rng(seed), size, 40)
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
    assert report.visible_triangles(boxes) == expected


def test_a_large_face_hides_what_is_behind():
    seen = report.visible_triangles([(0, 0, 0, 1, 1, 1), (1, 0, 0, 1, 1, 1), (0, 1, 0, 1, 1, 1), (0, 0, 1, 2, 2, 1)])
    assert {number for number, _ in seen.values()} == {1, 2, 3}


def recording_of(boxes, size, failure=Failure.STUCK):
    """An episode that placed these boxes and ended so."""
    moves = [Move((0, 0, w, d, h), (0, 0), (0, 0), 0, (x, y, w, d), z, Failure.NONE) for x, y, z, w, d, h in boxes]
    return Recording(0, size[2], moves, failure)


PICTURES = {
    "empty": ([], (3, 5, 2), Failure.TOTE_COLLISION),
    "one cell": ([(0, 0, 0, 1, 1, 1)], (1, 1, 1), Failure.STUCK),
    "27 kinds": (
        [(3 * i, 3 * j, 3 * k, i + 1, j + 1, k + 1) for i in range(3) for j in range(3) for k in range(3)],
        (9, 9, 9),
        Failure.NONE,
    ),
    "2000 items": (
        [(x, y, z, 2, 2, 1) for z in range(10) for x in range(0, 30, 2) for y in range(0, 28, 2)],
        (30, 30, 10),
        Failure.STUCK,
    ),
}


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.filterwarnings("error")
def test_tote_picture(name, tmp_path):
    boxes, size, failure = PICTURES[name]
    path = tmp_path / "tote.png"
    replay.picture(recording_of(boxes, size, failure), Rules(tote_size=size), path)
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("boxes", "failure", "ending"),
    [
        ([(0, 0, 0, 2, 1, 1)], Failure.STUCK, "50.0% full, 1 items placed. This item fits nowhere any more."),
        ([(0, 0, 0, 2, 2, 1)], Failure.STUCK, "100.0% full, 1 items placed. The tote is full."),
        ([(0, 0, 0, 2, 1, 1)], Failure.ITEM_COLLISION, "The gripper would hit an item in the tote."),
        ([(0, 0, 0, 2, 1, 1)], Failure.NONE, "The item stream is over."),
    ],
)
def test_caption_of_the_tote_picture(boxes, failure, ending):
    rules, recording = Rules(tote_size=(2, 2, 1)), recording_of(boxes, (2, 2, 1), failure)
    figure = report.draw_scene(recording, rules, report.item_colours(boxes))
    caption = figure.get_suptitle()
    assert caption.startswith("2x2x1 tote") and ending in caption
    numbers = [text.get_text() for text in figure.axes[1].texts]
    assert sorted(numbers) == (["0", "0", "1", "1"] if len(boxes[0]) and boxes[0][4] == 1 else ["1"] * 4)
    before = report.draw_scene(recording, rules, report.item_colours(boxes), moves=0)
    assert before.get_suptitle() == "2x2x1 tote, 0.0% full, 0 items placed"


CURVES = {
    "header only": "frames\n",
    "one row, nothing ended": "frames,time/fps\n128,900\n",
    "one row": "frames,train/occupancy,curriculum/level\n128,0.4,2\n",
    "no interval": "frames,train/occupancy,eval/occupancy\n128,0.4,\n256,0.5,0.6\n",
    "interval": "frames,eval/occupancy,eval/ci95_low,eval/ci95_high\n128,,,\n256,0.5,0.4,0.6\n384,1.0,1.0000001,1.0\n",
    "cut short": "frames,train/occupancy,curriculum/level\n128,0.4,2\n256,0.",
    "long": "frames,train/occupancy,curriculum/level\n"
    + "".join(f"{i},{i / 999},{1 + i // 300}\n" for i in range(999)),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.filterwarnings("error")
def test_learning_curve(name, tmp_path):
    metrics, path = tmp_path / "metrics.csv", tmp_path / "curve.png"
    metrics.write_text(CURVES[name])
    report.learning_curve(metrics, path)
    assert path.read_bytes().startswith(b"\x89PNG")


RESULT = {
    "planner": "joint_dbl",
    "checkpoint": None,
    "env": {"tote_size": [6, 6, 5], "rotations": 4},
    "stream": "test",
    "episodes": 4,
    "seed": 1,
    "occupancy": {"mean": 0.97777, "ci95": [0.97, 0.985], "min": 0.9722, "per_episode": [0.97] * 4},
    "items_placed": 76.5,
    "failures": {"stuck": 3, "unstable": 1},
    "feasible_action_share": 0.0925,
    "latency_ms": {"p50": 1.24, "p95": 1.44},
}


def table(result):
    """The rows of the Markdown table, as a dictionary."""
    lines = report.evaluation_table(result).splitlines()
    assert len({len(line) for line in lines}) == 1 and set(lines[1]) == {"|", "-"}
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line != lines[1]]
    return dict(rows)


def test_evaluation_table():
    rows = table(RESULT)
    assert rows["planner"] == "joint_dbl"
    assert rows["tote, rotations"] == "6x6x5, R=4"
    assert rows["episodes"] == "4 of the test stream, seed 1"
    assert rows["occupancy"] == "0.9778 (95% interval 0.9700 to 0.9850), least 0.9722"
    assert rows["episodes ended by"] == "stuck 3, unstable 1"
    assert rows["feasible actions"].startswith("9.25%")
    assert rows["one decision"] == "1.2 ms (median), 1.4 ms (95th percentile)"
    assert not any("mask" in name for name in rows)


def test_evaluation_table_of_a_policy():
    facts = {
        "checkpoint": "run/checkpoints/best",
        "trained": {"frames": 1_200_000, "seed": 3},
        "mask_in_training": True,
        "mask_at_decision": False,
        "candidates": 10,
        "latency_ms": None,
        "warm_start": "JointDBL",
    }
    rows = table(RESULT | facts)
    assert rows["mask; candidates K"] == "in training yes, at decision no; 10"
    assert rows["checkpoint"] == "run/checkpoints/best (1,200,000 frames, seed 3)"
    assert rows["warm start"] == "imitated JointDBL"
    assert "one decision" not in rows
    known_only_at_decision = {key: facts[key] for key in ("candidates", "mask_at_decision")}  # a planner of a user's
    assert table(RESULT | known_only_at_decision)["mask; candidates K"] == "in training unknown, at decision no; 10"
    assert "warm start" not in table(RESULT | facts | {"warm_start": None})


def test_importing_the_package_does_not_import_matplotlib():
    code = "import sys, pickplace.views.figures, pickplace.evaluation.evaluate; sys.exit('matplotlib' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_height_map_lies_as_the_tote():
    """x to the right, y upwards."""
    boxes, size = [(0, 0, 0, 2, 1, 1), (2, 3, 0, 1, 1, 2)], (3, 4, 2)
    recording = recording_of(boxes, size)
    figure = report.draw_scene(recording, Rules(tote_size=size), report.item_colours(boxes))
    plan = figure.axes[1]
    shown = np.zeros((3, 4), dtype=int)
    for text in plan.texts:
        x, y = text.get_position()
        shown[x, y] = int(text.get_text())
    expected = [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 2]]
    assert shown.tolist() == expected
    assert np.asarray(plan.images[0].get_array()).T.tolist() == expected and plan.images[0].origin == "lower"
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("x (cells)", "y (cells)")


def test_the_picture_in_3d_shows_items_where_they_lie():
    """The middle of a cube is half a cell above that of the floor below it."""
    size = (3, 4, 1)
    for x, y in ((0, 0), (2, 0), (0, 3), (2, 3)):
        boxes = [(x, y, 0, 1, 1, 1)]
        figure = report.draw_scene(recording_of(boxes, size), Rules(tote_size=size), report.item_colours(boxes))
        tote, cube = (part for part in figure.axes[0].collections if type(part).__name__ == "PolyCollection")
        corner, along_x, _, along_y = tote.get_paths()[0].vertices[:4]
        floor = corner + (along_x - corner) * (x + 0.5) / 3 + (along_y - corner) * (y + 0.5) / 4
        middle = np.mean([path.vertices[:3] for path in cube.get_paths()], axis=(0, 1))
        assert middle == pytest.approx(floor + [0, 0.5])
