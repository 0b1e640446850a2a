"""Recorded episodes are what happened, and the page shows them: in a real browser, without any network."""

import base64
import json
import re
import zlib
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from browser import errors, wait_until
from untrained import untrained_planner

from pickplace import CellSpec, Failure, PickPlaceEnv
from pickplace.evaluation.play import play
from pickplace.items.distributions import Kinds, Uniform
from pickplace.planners.heuristics import JointDBL, UniformRandom
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import AfterstateFcn
from pickplace.views import replay
from pickplace.views.motion import Motion, Outcome
from pickplace.views.recording import Move, Recording

ODD = {"bin_size": (4, 6, 2), "tote_size": (5, 7, 3), "effector_size": (2, 3), "rotations": 3, "height_unit": 0.25}
CELLS = {
    "paper": {},
    "odd": {**ODD, "items": Kinds([(1, 2, 2)])},
    "mixed": {"tote_size": (6, 5, 4), "effector_size": (4, 3), "items": Uniform((1, 3), (1, 3), (1, 2))},
    "preview": {"preview": 2, "items": Uniform((1, 2), (1, 3), (1, 2))},
    "several": {"bin_size": (6, 5, 1), "bin_items": 3, "items": Uniform((1, 2), (1, 3), (1, 2))},
}
PLANNERS = {
    "joint_dbl": JointDBL, "uniform": UniformRandom, "policy": untrained_planner,
    "K=1": partial(untrained_planner, candidates=1),
    "values": lambda cell: PolicyPlanner(cell, AfterstateFcn(cell, stem=4, filters=8, temperature=1.0).eval()),
}  # fmt: skip


@cache
def record(cell, planner):
    """Return a cell and three recorded episodes in it."""
    settings = {**CELLS[cell], "stream": "test", "masks": ()}

    def make_env(first, count):
        return PickPlaceEnv(**settings, num_envs=count, first_episode=first)

    cell = make_env(0, 1).cell
    return cell, play(make_env, PLANNERS[planner](cell), 4, 2, record=range(3))


@pytest.mark.parametrize(
    ("cell", "planner"), [("paper", "joint_dbl"), ("odd", "policy"), ("mixed", "K=1"), ("mixed", "values")]
)
def test_recordings_are_what_happened(cell, planner):
    cell, result = record(cell, planner)
    assert [recording.episode for recording in result.recordings] == [0, 1, 2]
    for number, recording in enumerate(result.recordings):
        heights = np.zeros(cell.tote_size[:2], dtype=int)
        for move in recording.moves[: len(recording.boxes)]:
            (x, y, w, d), (ix, iy, iw, idp, h) = move.footprint, move.item
            odd = move.rotation % 2
            assert not move.failure and (w, d) == ((idp, iw) if odd else (iw, idp))
            # The end effector covers the item in the bin, and after the turn in the tote.
            ee = cell.gripper.size
            for corner, size, at, reach in (
                ((ix, iy), (iw, idp), move.pick, ee), ((x, y), (w, d), move.place, ee[::-1] if odd else ee)
            ):  # fmt: skip
                assert all(at[i] <= corner[i] and corner[i] + size[i] <= at[i] + reach[i] for i in (0, 1))
            space = heights[x : x + w, y : y + d]
            assert space.max() == move.z
            space[:] = move.z + h
        failed = recording.moves[len(recording.boxes) :]
        assert [move.failure for move in failed] == [recording.ending] * (not recording.waiting)
        assert (heights == result.final_heights[number].numpy()).all()
        volume = sum(w * d * h for *_, w, d, h in recording.boxes)
        assert volume / heights.size / recording.tote_height == pytest.approx(recording.occupancy)
        assert recording.occupancy == float(result.occupancy[number])
        assert (len(recording.waiting) == 1) == (recording.ending == Failure.STUCK)
        assert len(recording.boxes) == int(result.items_placed[number])


def test_an_item_in_all_its_poses_is_one_item():
    cell = CellSpec(bin_size=(9, 3, 3), bin_items=3, tipping=True)
    one, two = (Recording(0, 5, ending=Failure.STUCK, waiting=[(0, 0, 2, 2, 3)] * count) for count in (3, 6))
    assert one.describe_ending(cell) == Failure.STUCK.sentence
    assert two.describe_ending(cell) == "None of these items fits anywhere any more."


def test_several_items_lie_in_the_bin_until_they_are_taken():
    cell, result = record("several", "joint_dbl")
    for recording in result.recordings:
        contents = [[move.item, *move.others] for move in recording.moves] + [recording.waiting]
        for move, lying, after in zip(recording.moves, contents, contents[1:], strict=False):
            cells = [(x + i, y + j) for x, y, w, d, _ in lying for i in range(w) for j in range(d)]
            assert len(cells) == len({*cells}) and 2 <= len(lying) <= 3
            assert [item for item in after if item in move.others] and {*move.others} <= {*after}
        assert recording.ending == Failure.STUCK and len(recording.waiting) > 1
        assert recording.describe_ending(cell) == "None of these items fits anywhere any more."
    episode, recording = unpack(replay.page(result.recordings, cell, ""))["episodes"][0], result.recordings[0]
    assert [[tuple(item) for item in others] for others in episode["others"]] == [m.others for m in recording.moves]
    assert [tuple(item) for item in episode["waiting"]] == recording.waiting


def test_recordings_say_what_is_seen_to_come():
    """The next items of the episode, in their order."""
    cell, result = record("preview", "joint_dbl")
    for recording in result.recordings:
        sizes = [move.item[2:] for move in recording.moves] + [item[2:] for item in recording.waiting]
        assert len(recording.moves) > 3
        for n, move in enumerate(recording.moves):
            seen = [item[2:] for item in move.coming]
            assert len(seen) == 2 and seen[: len(sizes) - n - 1] == sizes[n + 1 : n + 3]
    episode, recording = unpack(replay.page(result.recordings, cell, ""))["episodes"][0], result.recordings[0]
    assert [[tuple(item) for item in coming] for coming in episode["coming"]] == [m.coming for m in recording.moves]


def test_items_that_are_never_taken_have_a_colour():
    move = Move((0, 0, 2, 1, 3), (0, 0), (0, 0), 0, (0, 0, 2, 1), 0, Failure.NONE, others=[(3, 0, 1, 1, 2)])
    recordings = [Recording(0, 6, [move]), Recording(1, 6, [move], Failure.STUCK, [(0, 2, 1, 3, 1)])]
    assert set(unpack(replay.page(recordings, CellSpec(bin_items=2), ""))["colours"]) == {"1,2,3", "1,1,2", "1,3,1"}


def unpack(html):
    packed = re.search(r'id="data">([^<]*)<', html)[1]
    return json.loads(zlib.decompress(base64.b64decode(packed)))


@pytest.mark.parametrize("planner", ["policy", "values"])
def test_page_is_one_file_that_holds_the_episodes(planner):
    cell, result = record("paper", planner)
    html = replay.page(result.recordings, cell, "a <b> & c")
    data = unpack(html)
    assert "{{" not in html and "<title>a &lt;b&gt; &amp; c</title>" in html
    assert not re.search(r'(src|href)="(?!data:)', html) and "import(" not in html.split("<script>")[-1]
    assert data["tote"] == [6, 6] and data["title"] == "a <b> & c"
    for source, recording in zip(data["episodes"], result.recordings, strict=True):
        assert len(source["moves"]) == len(recording.moves) and source["occupancy"] == recording.occupancy
        heat = np.frombuffer(base64.b64decode(source["heat"]), dtype=np.uint8).reshape(-1, 6, 6)
        assert all((a == move.heat).all() and a.max() == 255 for a, move in zip(heat, recording.moves, strict=True))
    kinds = {",".join(map(str, sorted(move[2:4]))) + f",{move[4]}" for e in data["episodes"] for move in e["moves"]}
    assert kinds <= set(data["colours"])


def test_heights_on_the_page_are_in_cells():
    moves = [Move((0, 0, 2, 1, h), (0, 0), (0, 0), 0, (0, 0, 2, 1), z, Failure.NONE) for z, h in ((0, 3), (3, 2))]
    recording = Recording(0, 6, moves, Failure.STUCK, [(1, 1, 1, 1, 7)], 0.5)
    cell = CellSpec(bin_size=(5, 5, 3), height_unit=0.1)
    data = unpack(replay.page([recording], cell, ""))
    episode = data["episodes"][0]
    assert (data["bin"], episode["height"], episode["waiting"]) == ([5, 5, 0.3], 0.6, [[1, 1, 1, 1, 0.7]])
    assert [(move[4], move[14]) for move in episode["moves"]] == [(0.3, 0), (0.2, 0.3)]
    assert set(data["colours"]) == {"1,2,0.3", "1,2,0.2", "1,1,0.7"}
    double = unpack(replay.page([recording], CellSpec(height_unit=2), ""))
    assert set(double["colours"]) == {"1,2,6", "1,2,4", "1,1,14"}  # written as a browser writes whole numbers


def test_animation(tmp_path):
    from PIL import Image

    cell, result = record("paper", "joint_dbl")
    replay.animation(result.recordings[0], cell, tmp_path / "replay.gif", seconds=1, frames=4)
    with Image.open(tmp_path / "replay.gif") as image:
        assert image.n_frames == 4 and image.info["loop"] == 0


# ---------------------------------------------------------------------- in a browser
def open_page(browser, path, fragment=""):
    browser.get("about:blank")
    browser.get_log("browser")  # empties it
    browser.get(f"file://{path}{fragment}")
    wait_until(browser, "window.replay && window.replay.ready")
    return lambda: browser.execute_script("return replay.state()")


def colours_on_canvas(browser):
    """How many different colours the 3D picture has."""
    return browser.execute_script(
        "const c = document.querySelector('#stage > canvas'), t = document.createElement('canvas');"
        "t.width = 200; t.height = 140; const p = t.getContext('2d'); p.drawImage(c, 0, 0, 200, 140);"
        "const d = p.getImageData(0, 0, 200, 140).data, s = new Set();"
        "for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return s.size"
    )


def written(tmp_path, recordings, cell, at_end=False):
    path = tmp_path / "replay.html"
    path.write_text(replay.page(recordings, cell, "title", at_end), encoding="utf-8")
    return path


def test_page_opens_steps_plays_and_changes_episodes(browser, tmp_path):
    cell, result = record("paper", "policy")
    state = open_page(browser, written(tmp_path, result.recordings, cell), "#episode=0&step=0")
    moves = result.recordings[0].moves
    assert state()["moves"] == len(moves) and state()["shown"] == 0 and not state()["playing"]
    blank = colours_on_canvas(browser)
    assert blank > 5

    click = {name: browser.find_element("id", name).click for name in ("forward", "back", "play", "heat", "view")}
    click["forward"]()
    wait_until(browser, "!replay.state().playing && replay.state().shown === 1")
    click["back"]()
    assert state()["at"] == 0
    browser.execute_script("document.getElementById('speed').value = 350")
    click["play"]()
    wait_until(browser, f"replay.state().at === {len(moves)}")
    end = state()
    assert end["shown"] == len(moves) and not end["playing"]
    assert end["ending"] == result.recordings[0].describe_ending(cell)
    assert abs(float(end["percent"].rstrip("%")) / 100 - result.recordings[0].occupancy) <= 0.001
    assert colours_on_canvas(browser) > blank
    click["heat"]()
    click["view"]()

    browser.execute_script("const e = document.getElementById('episode'); e.value = 2; e.onchange()")
    assert state()["episode"] == 2 and state()["at"] == 0 and state()["moves"] == len(result.recordings[2].moves)
    browser.execute_script("location.hash = '#episode=1&step=2'")
    wait_until(browser, "replay.state().episode === 1 && replay.state().shown === 2")
    assert errors(browser) == []
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in fetched if not name.startswith(("data:", "blob:"))] == []


def test_page_opens_at_the_end(browser, tmp_path):
    cell, result = record("paper", "policy")
    state = open_page(browser, written(tmp_path, result.recordings[1:], cell, at_end=True))
    moves = len(result.recordings[1].moves)
    assert (state()["episode"], state()["at"]) == (1, moves) and not state()["playing"]
    browser.find_element("id", "play").click()
    wait_until(browser, f"replay.state().at < {moves}")


@pytest.mark.slow
def test_page_of_very_many_moves(browser, tmp_path):
    """More than a function takes arguments."""
    moves = [Move((1, 1, 1, 1, 1 + n % 2), (0, 0), (0, 0), 0, (0, 0, 1, 1), 0, Failure.NONE) for n in range(1500)]
    recordings = [Recording(n, 5, moves, Failure.STUCK, [(0, 0, 1, 1, 4)], 1.0) for n in range(100)]
    state = open_page(browser, written(tmp_path, recordings, CellSpec()))
    assert state()["moves"] == 1500 and errors(browser) == []


@pytest.mark.parametrize("planner", ["K=1", "uniform"])  # with a heat map, and without
def test_page_shows_a_failure_in_place(browser, tmp_path, planner):
    cell, result = record("paper", planner)
    failing = next(r for r in result.recordings if r.ending not in (Failure.STUCK, Failure.NONE))
    state = open_page(browser, written(tmp_path, [failing], cell), "#step=9999")
    assert state()["ending"] == failing.ending.sentence
    assert state()["shown"] == len(failing.boxes) == len(failing.moves) - 1
    assert browser.find_element("id", "ending").get_attribute("class") == "bad"
    assert browser.find_element("id", "heat-label").is_displayed() == (planner == "K=1")
    assert errors(browser) == []


def test_page_shows_what_physics_did(browser, tmp_path):
    """Two items, the second of which is lost: poses between two pictures, and the words."""
    moves = [Move((0, 0, 2, 1, 1), (0, 0), (0, 0), n, (x, 0, *size), 0, Failure.NONE)
             for n, (x, size) in enumerate(((0, (2, 1)), (3, (1, 2))))]  # fmt: skip
    turned = (0.5**0.5, 0, 0, 0.5**0.5)
    first = [(0, -0.3, 0.05, 0.025, 1, 0, 0, 0), (4, 0.05, 0.025, 0.025, 1, 0, 0, 0)]
    second = [(5, -0.3, 0.05, 0.025, 1, 0, 0, 0), (9, 0.2, 0.1, 0.025, *turned)]
    plate = [(0, -0.3, 0.05, 0.3, 1, 0, 0, 0), (8, -0.3, 0.05, 0.3, *turned)]
    motion = Motion((-0.5, 0.1), 10, plate, [first, second], [5, 10])
    carried_out = Outcome(
        0, "collapsed", 1, 1, 1, 0.25, 0.0, 0.0, "Item 2 left its place.", "item 2 left its place", motion
    )
    recording = Recording(0, 5, moves, Failure.STUCK, [], 0.5, carried_out)
    path = written(tmp_path, [recording], CellSpec())
    assert unpack(path.read_text())["binAt"] == [-10, 2]
    state = open_page(browser, path)
    browser.execute_script(WATCH + "document.getElementById('seek').step = 'any'")

    def poses(moment):
        """The visible boxes and the gripper: position and turn about z."""
        browser.execute_script(
            "window.scene = null; const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput()",
            moment,
        )
        wait_until(browser, "!!window.scene")
        return browser.execute_script(
            "const all = scene.children.find(o => o.isGroup && o.children.some(c => c.userData.poses)).children;"
            "const arm = scene.children.find(o => o.isGroup && o.children.some(c => c.isInstancedMesh));"
            "return [...all.filter(o => o.visible), arm].map(o => [...o.position.toArray(), o.rotation.z])"
        )

    assert poses(0.2) == [pytest.approx([-6, 1, 0.5, 0], abs=2e-3), pytest.approx([-6, 1, 5.72, 0], abs=2e-3)]  # 1
    assert poses(0.7)[0] == pytest.approx([-2.5, 0.75, 0.5, 0], abs=2e-3)  # 3.5: half of the way since 3
    lies, brought, arm = poses(1.7)  # 8.5
    assert lies == pytest.approx([1, 0.5, 0.5, 0], abs=2e-3)
    assert brought == pytest.approx([-1, 1.5, 0.5, np.pi / 4], abs=4e-3)
    assert arm[3] == pytest.approx(np.pi / 2, abs=2e-3)
    assert poses(2)[1] == pytest.approx([4, 2, 0.5, np.pi / 2], abs=2e-3)
    assert (state()["ending"], state()["percent"]) == ("Item 2 left its place.", "1.1%")
    assert browser.find_element("id", "which").text == "1 item placed"
    assert browser.find_element("id", "legend").text.endswith("the lost item")
    assert errors(browser) == []

    # A failing move is not carried out, and the episode still counts as failed.
    failing = replace(moves[1], failure=Failure.TOTE_COLLISION)
    motion = Motion((-0.5, 0.1), 5, plate, [first], [5])
    kept = Outcome(0, "done", None, None, 1, 2 / 180, 0.0, 0.0, "Carried out.", "carried out", motion)
    recording = Recording(0, 5, [moves[0], failing], Failure.TOTE_COLLISION, [], 2 / 180, kept)
    state = open_page(browser, written(tmp_path, [recording], CellSpec()), "#step=9")
    assert state()["ending"] == f"Carried out. {Failure.TOTE_COLLISION.sentence}"
    assert browser.find_element("id", "ending").get_attribute("class") == "bad" and state()["moves"] == 1
    assert errors(browser) == []


def test_page_shows_all_that_lies_in_the_bin(browser, tmp_path):
    """Before, during and after each move, and at the end; by hand. The bin's corner is at (-7, 0.5)."""
    a, b, c, d = (0, 0, 2, 1, 1), (3, 1, 1, 1, 2), (0, 3, 1, 2, 3), (3, 3, 1, 1, 1)
    moves = [
        Move(b, (2, 0), (0, 0), 0, (0, 0, 1, 1), 0, Failure.NONE, others=[a, c]),
        Move(a, (0, 0), (3, 3), 0, (3, 3, 2, 1), 0, Failure.NONE, others=[c, d]),
    ]
    cell = CellSpec(bin_items=3)
    recording = Recording(0, 5, moves, Failure.STUCK, [c, d, b], 0.1)
    state = open_page(browser, written(tmp_path, [recording], cell))
    browser.execute_script(WATCH + "document.getElementById('seek').step = 'any'")

    def lying(moment):
        """The items on the floor of the bin that are visible: x, y, w, d, h."""
        browser.execute_script(
            "window.scene = null; const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput()",
            moment,
        )
        wait_until(browser, "!!window.scene")
        boxes = browser.execute_script(
            "const is = o => o.children.length === 2 && o.children[0].isMesh && o.children[1].isLineSegments;"
            "const items = o => !o.isGroup || !o.visible ? [] : is(o) ? [o] : o.children.flatMap(items);"
            "return scene.children.flatMap(items).map(o => "
            "[...o.position.toArray(), ...o.children[0].scale.clone().multiply(o.scale).toArray()])"
        )
        found = [(x - w / 2 + 7, y - d / 2 - 0.5, w, d, h) for x, y, z, w, d, h in boxes if abs(z - h / 2) < 0.05]
        found = [tuple(round(part, 1) for part in box) for box in found if box[0] < 5]
        assert len(found) == len({*found})
        return {*found}

    assert lying(0) == lying(0.1) == {a, b, c}
    assert lying(0.25) == lying(0.6) == {a, c}  # b is lifted, and over the tote
    assert lying(0.9) == lying(1) == {a, c, d}
    assert lying(1.6) == {c, d}
    assert lying(1.9) == lying(2) == {b, c, d}
    assert state()["ending"] == "None of these items fits anywhere any more."
    assert browser.find_element("id", "legend").text.count("×") == 2 * 4
    assert errors(browser) == []

    # Carried out: c and d stayed in the bin, and b came after that; each is there once.
    def pose(at, item):
        x, y, w, d, h = item
        return (at, *(0.05 * np.array((x + w / 2 - 7, y + d / 2 + 0.5, h / 2))).tolist(), 1, 0, 0, 0)

    boxes = [[pose(0, b), (6, 0.025, 0.025, 0.05, 1, 0, 0, 0)], [pose(0, a), (15, 0.2, 0.175, 0.025, 1, 0, 0, 0)],
             [pose(0, c)], [pose(10, d)]]  # fmt: skip
    motion = Motion(
        (-0.35, 0.025), 20, [(0, -0.3, 0.05, 0.5, 1, 0, 0, 0)], boxes, [10, 20], [(0.05, 0.1, 0.15), (0.05,) * 3]
    )
    kept = Outcome(0, "done", None, None, 2, 0.1, 0.0, 0.0, "Carried out.", "carried out", motion)
    state = open_page(browser, written(tmp_path, [replace(recording, carried_out=kept)], cell))
    browser.execute_script(WATCH + "document.getElementById('seek').step = 'any'")
    assert state()["moves"] == 2 and lying(0.1) == {a, b, c} and lying(0.8) == {a, c}
    assert lying(1.2) == {a, c, d} and lying(1.9) == {c, d} and lying(2) == {b, c, d}
    assert errors(browser) == []


#: Notes the scene that is drawn, and where each square of the heat map lies.
WATCH = """
window.squares = {};
const update = THREE.Object3D.prototype.updateMatrix, set = THREE.InstancedMesh.prototype.setMatrixAt;
THREE.Object3D.prototype.updateMatrix = function () {
  if (this.isScene) window.scene = this;
  return update.call(this);
};
THREE.InstancedMesh.prototype.setMatrixAt = function (n, m) {
  window.squares[n] = [...m.elements.slice(12, 15)];
  return set.call(this, n, m);
};
"""


def test_page_names_what_is_seen_to_come(browser, tmp_path):
    kinds = [(0, 0, 1, 1, n) for n in (1, 2, 3, 4, 5)]
    moves = [
        Move((0, 0, 2, 1, 1), (0, 0), (0, 0), 0, (0, 0, 2, 1), 0, Failure.NONE, coming=kinds[:n]) for n in (2, 5, 0)
    ]
    state = open_page(browser, written(tmp_path, [Recording(0, 5, moves, Failure.NONE, [], 0.1)], CellSpec(preview=5)))
    browser.execute_script("document.getElementById('seek').step = 'any'")
    ends = (
        "at height 0; next 1 × 1 × 1, 1 × 1 × 2",
        "; next 1 × 1 × 1, 1 × 1 × 2, 1 × 1 × 3, 1 × 1 × 4, ...",
        "set down at height 0",
    )
    for step, end in enumerate(ends):
        browser.execute_script(
            "const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput()", step + 0.05
        )
        wait_until(browser, f"document.getElementById('which').textContent === 'Item {step + 1} of 3'")
        assert browser.find_element("id", "what").text.endswith(end)
    assert state()["moves"] == 3 and errors(browser) == []


def test_page_puts_things_where_they_are(browser, tmp_path):
    """On a tote that is not square, a carried item ends in its footprint, and the heat map on the surface; in cells."""
    cell, result = record("odd", "policy")
    open_page(browser, written(tmp_path, result.recordings, cell), "#episode=0&step=0")
    browser.execute_script(WATCH + "document.getElementById('seek').step = 'any'")
    (wide, deep, _), unit = cell.tote_size, cell.height_unit
    heights, turns = np.zeros((wide, deep)), set()
    for number, move in enumerate(result.recordings[0].moves):
        if move.failure:
            break
        for moment in (0, 0.75):  # before it, and set down but not let go
            script = (
                "window.scene = null; const s = document.getElementById('seek'); s.value = arguments[0]; s.oninput();"
                "document.getElementById('heat').onchange()"  # which draws the map again
            )
            browser.execute_script(script, number + moment)
            wait_until(browser, "!!window.scene")
            if moment == 0:
                squares = browser.execute_script("return window.squares")
                for place, (x, y) in enumerate(np.ndindex(wide, deep)):
                    expected = [x + 0.5, y + 0.5, unit * heights[x, y] + 0.02]
                    assert squares[str(place)] == pytest.approx(expected, abs=1e-4)
        where = browser.execute_script(
            "const item = scene.children.find(o => o.isGroup && o.children.length === 2 && o.children[0].isMesh);"
            "return [...item.position.toArray(), item.rotation.z]"
        )
        x, y, w, d = move.footprint
        assert where[:3] == pytest.approx([x + w / 2, y + d / 2, unit * (move.z + move.item[4] / 2)], abs=0.01)
        assert where[3] == pytest.approx({0: 0, 1: np.pi / 2, 2: np.pi, 3: -np.pi / 2}[move.rotation], abs=1e-6)
        heights[x : x + w, y : y + d] = move.z + move.item[4]
        turns.add(move.rotation)
    assert len(turns) > 1
