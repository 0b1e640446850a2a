"""Plans as files: what an evaluation writes, what is read back, and what is refused."""

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.physics import command, plans
from pickplace.physics.neighbours import BoxIndex
from pickplace.physics.plans import KEYS, OPTIONAL_KEYS, ROBOT_KEYS, EpisodePlan, Placement, read_plans, to_lines
from pickplace.physics.recorded import plan_of
from pickplace.rules.state import Failure
from pickplace.views.recording import Move, Recording

LINE = {"episode": 0, "tote": [0.3, 0.3, 0.2], "corner": [0.0, 0.0, 0.0], "size": [0.1, 0.1, 0.05]}
ROBOT = {
    "bin": [0.25, 0.25, 0.05],
    "item": [0, 0],
    "effector": [0.15, 0.15],
    "pick": [0.1, 0.1],
    "place": [0.1, 0.1],
    "rotation": 90,
}


def written(path, *lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def test_a_recorded_episode_in_metres(tmp_path):
    """Cells of 4 cm, heights of 1 cm; by hand."""
    cell = CellSpec((5, 5, 3), (6, 6, 20), effector_size=(3, 2), height_unit=0.25)
    moves = [
        Move((2, 1, 2, 1, 5), (1, 0), (0, 1), 1, (0, 2, 1, 2), 0, Failure.NONE),
        Move((0, 0, 1, 1, 4), (0, 0), (0, 0), 0, (0, 2, 1, 1), 5, Failure.NONE, grams=1500),
        Move((0, 0, 1, 1, 4), (0, 0), (5, 5), 0, (5, 5, 1, 1), 0, Failure.TOTE_COLLISION),
    ]
    plan = plan_of(Recording(7, 18, moves), replace(cell, cell_size=0.04))
    first = Placement((0, 0.08, 0), (0.04, 0.08, 0.05), (0.08, 0.04), (0.1, 0.04), (0.04, 0.1), 90)
    assert plan == EpisodePlan(7, (0.24, 0.24, 0.18), (0.2, 0.2, 0.03), (0.12, 0.08), [first, plan.placements[1]])
    assert plan.placements[1].corner == (0, 0.08, 0.05) and plan.placements[1].rotation == 0
    assert [placement.mass for placement in plan.placements] == [0.0, 1.5]
    path = tmp_path / "plans.jsonl"
    path.write_text(to_lines([plan, EpisodePlan(8, (1.0, 1.0, 1.0), placements=[Placement((0, 0, 0), (1, 1, 1))])]))
    assert list(map(json.loads, path.read_text().splitlines()))[0].keys() == {*KEYS, *ROBOT_KEYS}
    back = read_plans(path)
    assert back[0] == plan and back[1].placements == [Placement((0, 0, 0), (1, 1, 1))]
    written(path, {**LINE, "mass": 2.5})  # enough for `settle`
    assert read_plans(path)[0].placements == [Placement((0, 0, 0), (0.1, 0.1, 0.05), mass=2.5)]


@pytest.mark.parametrize(("change", "words"), [
    ({"corner": [0.25, 0, 0]}, "the item .* x .* 0.25 to 0.35 m"),
    ({"corner": [0, 0, 0.16]}, "the item .* z .* 0.16 to 0.21 m"),
    ({"corner": [0.05, 0.02, 0.03]}, "the item .* item 1 .* 20.0 mm"),
    ({"corner": [0.05, 0.02, 0.06]}, "the item floats 10.0 mm"),
    ({"corner": [0.1, 0.0, 0.05]}, "the item floats 50.0 mm"),
    ({"corner": [0, 0, math.nan]}, r"corner=\[0, 0, nan\]: "),
    ({"corner": [0, 0]}, r"corner=\[0, 0\]: "),
    ({"size": [0.1, 0, 0.1]}, r"size=\[0.1, 0, 0.1\]: "),
    ({"size": "large"}, "size='large': "),
    *(({"episode": value}, f"episode={value}: ") for value in (0.5, -1)),
    *(({"mass": value}, f"mass={value}: expected a mass above 0") for value in (0, -1, 1e9)),
    ({"tote": [0.3, 0.3, 0.3]}, "tote: .* episode 0"),
    ({"volume": 1}, "'volume': "),
    ({"pick": [0, 0]}, "bin: missing"),
    ({**ROBOT, "rotation": 45}, "rotation=45: "),
    *(
        ({**ROBOT, "body": body}, "body.*: ")
        for body in ("L", [[0, 0, 0.1]], [[0, 0, 0.2, 0.1]], [[-0.1, 0, 0.1, 0.1]], [[0, 0, 0.1, 0]])
    ),
    ({"body": [[0, 0, 0.1, 0.1]]}, "bin: missing"),
    *(
        ({**ROBOT, "neighbours": value}, "neighbours=.*: ")
        for value in (
            "one", {}, None, [0.1], [[0.1, 0.1, 0.1, 0.1]], [[0.1, 0.1, 0.1, 0.1, 0]], [[1e3, 0, 0.1, 0.1, 0.1]],
            [[0.1, 0.1, 0.1, 0.1, None]], [[n, 1, 0.5, 0.5, 0.5] for n in range(101)],
        )
    ),
    ({**ROBOT, "size": [0.1, 0.05, 0.05], "neighbours": [[0.04, 0, 0.1, 0.1, 0.1]]},
     r"neighbours: \[0.04, 0.0, .*\] overlaps \[0.0, 0.0, 0.05, 0.1"),
    ({**ROBOT, "neighbours": [[0.1, 0.1, 0.1, 0.1, 0.1]] * 2}, "neighbours: .* overlaps .* in the bin"),
    ({"neighbours": [[0.1, 0.1, 0.1, 0.1, 0.1]]}, "bin: missing"),
    ({**ROBOT, "neighbours": [[0.9, 0, 0.05, 0.05, 0.05]]}, r"neighbours: \[0.9, .*\] leaves the bin of 0.25 x 0.25"),
])  # fmt: skip
def test_a_bad_line_is_refused(change, words, tmp_path):
    path = written(tmp_path / "plans.jsonl", LINE, LINE | {"corner": [0.1, 0.1, 0]} | change)
    with pytest.raises(ValueError, match=f"plans.jsonl, line 2: {words}") as error:
        read_plans(path)
    assert str(error.value).count("\n") == 0


def test_a_body_in_metres(tmp_path):
    """An L of cells of 5 cm, written and read."""
    cell = CellSpec(effector_size=(3, 2), body=[[1, 1], [1, 0], [1, 0]], cup=[[1, 0], [0, 0], [0, 0]])
    move = Move((2, 1, 1, 1, 1), (2, 1), (0, 0), 0, (0, 0, 1, 1), 0, Failure.NONE)
    plan = plan_of(Recording(0, 5, [move]), cell)
    assert plan.body == ((0.0, 0.0, 0.05, 0.1), (0.05, 0.0, 0.1, 0.05))
    (tmp_path / "plans.jsonl").write_text(to_lines([plan]))
    assert read_plans(tmp_path / "plans.jsonl") == [plan]


def test_neighbours_in_metres(tmp_path):
    """Cells of 4 cm, heights of 1 cm; by hand. Only the move that has neighbours names them."""
    cell = CellSpec((5, 5, 3), (6, 6, 20), effector_size=(3, 2), height_unit=0.25, bin_items=2)
    moves = [
        Move((2, 1, 2, 1, 5), (1, 0), (0, 1), 0, (0, 1, 2, 1), 0, Failure.NONE, others=[(0, 3, 1, 2, 6)]),
        Move((0, 3, 1, 2, 6), (0, 2), (3, 3), 0, (3, 3, 1, 2), 0, Failure.NONE),
    ]
    plan = plan_of(Recording(0, 20, moves), replace(cell, cell_size=0.04))
    assert [one.neighbours for one in plan.placements] == [((0.0, 0.12, 0.04, 0.08, 0.06),), ()]
    (tmp_path / "plans.jsonl").write_text(to_lines([plan]))
    lines = [json.loads(line) for line in (tmp_path / "plans.jsonl").read_text().splitlines()]
    assert [line.get("neighbours") for line in lines] == [[[0.0, 0.12, 0.04, 0.08, 0.06]], None]
    assert read_plans(tmp_path / "plans.jsonl") == [plan]


@pytest.mark.parametrize(("text", "words"), [
    ("corner\n", r"line 1: .*JSON \("),
    ("[1]\n", "line 1: got list, "),
    (json.dumps({"episode": 1}) + "\n", "line 1: tote: missing"),
])  # fmt: skip
def test_another_file_is_refused(text, words, tmp_path):
    (tmp_path / "plans.jsonl").write_text(text)
    with pytest.raises(ValueError, match=words):
        read_plans(tmp_path / "plans.jsonl")


def test_an_episode_without_placements_has_no_line(tmp_path):
    (tmp_path / "plans.jsonl").write_text(to_lines([EpisodePlan(0, (1.0, 1.0, 1.0))]))
    assert read_plans(tmp_path / "plans.jsonl") == []


def test_the_lines_of_an_episode_follow_one_another(tmp_path):
    path = written(tmp_path / "plans.jsonl", LINE, LINE | {"episode": 1}, LINE | {"corner": [0.1, 0, 0]})
    with pytest.raises(ValueError, match="line 3: episode=0: "):
        read_plans(path)


def column(count, side=0.1, height=0.001):
    """Return lines of plates on one another, in one episode."""
    tote = {"tote": [0.3, 0.3, 90.0]}
    return [LINE | tote | {"corner": [0, 0, n * height], "size": [side, side, height]} for n in range(count)]


@pytest.mark.parametrize(
    "lines",
    [
        lambda n: column(n),  # as many in one column
        lambda n: [LINE | {"tote": [9.0, 9.0, 0.2], "corner": [0.1 * (i % 50), 0.1 * (i // 50), 0]} for i in range(n)],
        lambda n: [LINE | {"episode": i} for i in range(n)],
    ],
)
def test_the_time_of_a_long_file_grows_with_its_length(lines, tmp_path, monkeypatch):
    """Counted in pairs of boxes and in comparisons of episodes, which no busy machine changes."""
    counts, shared = [], plans._shared

    class Episode(int):
        def __eq__(self, other):
            counts[-1] += 1
            return int(self) == int(other)

        __hash__ = int.__hash__

    def counted(*boxes):
        counts[-1] += 1
        return shared(*boxes)

    read = plans._read_line
    monkeypatch.setattr(plans, "_shared", counted)
    monkeypatch.setattr(plans, "_read_line", lambda line: (v := read(line)) | {"episode": Episode(v["episode"])})
    for number in (200, 800):
        counts.append(0)
        read_plans(written(tmp_path / "plans.jsonl", *lines(number)))
        assert counts[-1] <= 40 * number


@given(st.data())
def test_boxes_near_a_box_are_all_found(data):
    """Against every pair, for sides from a micrometre to the longest."""
    side = st.one_of(st.floats(1e-6, 100.0), st.sampled_from([1e-6, 0.05, 0.1, 0.125, 0.25, 100.0]))
    place = st.one_of(st.floats(-100, 100), st.sampled_from([0.0, 0.05, 0.1, 0.125, 0.25, -0.1]))
    box = st.tuples(st.tuples(place, place, place), st.tuples(side, side, side))
    boxes, asked = data.draw(st.lists(box, max_size=12)), data.draw(box)
    index = BoxIndex()
    for corner, size in boxes:
        index.add(corner, size)
    margin = data.draw(st.sampled_from([0.0, 1e-4, 0.3]))
    expected = [n for n, (corner, size) in enumerate(boxes) if min(plans._shared(*asked, corner, size)) > -margin]
    found = index.near(*asked, margin)
    assert set(expected) <= set(found) and found == sorted(set(found))


def test_the_gap_below_an_item_is_measured_to_the_nearest_below_it(tmp_path):
    high = LINE | {"corner": [0.0, 0.0, 0.15]}
    with pytest.raises(ValueError, match="line 2: the item floats 100.0 mm"):
        read_plans(written(tmp_path / "plans.jsonl", LINE, high))


VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.floats(), max_size=4)


@given(st.dictionaries(st.sampled_from([*KEYS, *ROBOT_KEYS, *OPTIONAL_KEYS, "x"]), VALUES), st.booleans())
def test_any_line_is_read_or_refused_in_a_sentence(tmp_path_factory, values, for_robot):
    path = written(tmp_path_factory.mktemp("plans") / "plans.jsonl", LINE | (ROBOT if for_robot else {}) | values)
    try:
        read_plans(path)
    except ValueError as error:
        assert str(error).endswith(".") and "line 1" in str(error)


def test_the_command(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mujoco")
    tower = [LINE | {"corner": [0.06 * level, 0, 0.05 * level]} for level in range(2)]
    path = written(tmp_path / "plans.jsonl", *tower, LINE | {"episode": 3})

    def call(*words):
        monkeypatch.setattr("sys.argv", ["pickplace-physics", *map(str, words)])
        command.main()
        return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    fallen, done = call(path)
    assert (fallen["episode"], fallen["ending"], fallen["lost"]) == (0, "collapsed", 1)
    assert (done["episode"], done["ending"], done["placed"]) == (3, "done", 1)
    assert call(path, "friction=0.5", "sleep=false")[1]["placed"] == 1
    for words, expected in (
        ((path, "friction=-1"), "physics.friction=-1: "),
        ((path, "fricton=1"), "physics.fricton: "),
        *(((path, word), f"{word}: ") for word in ("friction", "friction=[1", "_target_=x")),
        ((path, "--method", "execute", "friction=0.3"), "physics=execute: episode 0 has no bin"),
        ((path, "--method", "setle"), "physics._target_=setle: "),
        ((path, "gap=0.02"), None),
        ((path, "gap=0.06"), "episode 0, item 1: 0.1 m wide"),
        ((tmp_path / "none.jsonl",), "none.jsonl: No such file"),
    ):
        if expected is None:
            assert len(call(*words)) == 2
            continue
        with pytest.raises(SystemExit, match="2"):
            call(*words)
        err = capsys.readouterr().err
        assert expected in err and err.count("\n") == 1
