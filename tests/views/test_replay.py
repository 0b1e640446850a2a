"""Recorded episodes are what happened, and the page shows them: in a real browser, without any network."""

import base64
import json
import re
import shutil
import time
import zlib
from functools import cache, partial

import numpy as np
import pytest
import torch
from untrained import untrained_planner

from pickplace import CellSpec, Failure, PickPlaceEnv
from pickplace.evaluation.play import play
from pickplace.planners.heuristics import JointDBL, UniformRandom
from pickplace.task.items import Kinds, Uniform
from pickplace.views import replay
from pickplace.views.recording import FULL, Move, Recording

CELLS = {
    "paper": ({}, None),
    "odd": (
        {"bin_size": (4, 6, 2), "tote_size": (5, 7, 3), "effector_size": (2, 3), "rotations": 3, "height_unit": 0.25},
        Kinds([(1, 2, 2)]),
    ),
    "mixed": ({"tote_size": (6, 5, 4), "effector_size": (4, 3)}, Uniform((1, 3), (1, 3), (1, 2))),
}
PLANNERS = {
    "joint_dbl": JointDBL, "uniform": UniformRandom, "policy": untrained_planner,
    "K=1": partial(untrained_planner, candidates=1), "K=5": partial(untrained_planner, candidates=5),
}  # fmt: skip


@cache
def record(cell, planner):
    """Return a cell and three recorded episodes in it."""
    settings, items = CELLS[cell]

    def make_env(first, count):
        return PickPlaceEnv(**settings, items=items, num_envs=count, stream="test", first_episode=first, masks=())

    cell = make_env(0, 1).cell
    return cell, play(make_env, PLANNERS[planner](cell), 4, 2, record=range(3))


@pytest.mark.parametrize(
    ("cell", "planner"), [("paper", "joint_dbl"), ("odd", "policy"), ("mixed", "K=5"), ("odd", "K=5")]
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
            ee = cell.effector_size
            for corner, size, at, reach in (
                ((ix, iy), (iw, idp), move.pick, ee), ((x, y), (w, d), move.place, ee[::-1] if odd else ee)
            ):  # fmt: skip
                assert all(at[i] <= corner[i] and corner[i] + size[i] <= at[i] + reach[i] for i in (0, 1))
            space = heights[x : x + w, y : y + d]
            assert space.max() == move.z
            space[:] = move.z + h
        failed = recording.moves[len(recording.boxes) :]
        assert [move.failure for move in failed] == [recording.ending] * (recording.waiting is None)
        assert (heights == result.final_heights[number].numpy()).all()
        volume = sum(w * d * h for *_, w, d, h in recording.boxes)
        assert volume / heights.size / recording.tote_height == pytest.approx(recording.occupancy)
        assert recording.occupancy == float(result.occupancy[number])
        assert (recording.waiting is not None) == (recording.ending == Failure.STUCK)
        assert len(recording.boxes) == int(result.items_placed[number])


@pytest.mark.parametrize("candidates", ["all", 3])
def test_heat_map_against_a_loop(candidates):
    settings = {"tote_size": (4, 5, 3), "rotations": 3}
    cell = CellSpec(**settings)
    planner = untrained_planner(cell, candidates)
    observation = PickPlaceEnv(**settings, num_envs=3).rollout(4, break_when_any_done=False)[:, -1]
    heat = planner.heat_map(observation)
    score = planner.policy.action_log_probs(observation).exp()
    for row in range(3):
        best = torch.zeros(4, 5)
        for action in range(cell.num_actions):
            if candidates == "all" and not observation["action_mask"][row, action]:
                continue
            x, y = divmod(action // cell.rotations % cell.num_places, 5)
            best[x, y] = max(best[x, y], score[row, action])
        assert torch.allclose(heat[row], best)
    assert heat.max() > 0


def unpack(html):
    packed = re.search(r'id="data">([^<]*)<', html)[1]
    return json.loads(zlib.decompress(base64.b64decode(packed)))


def test_page_is_one_file_that_holds_the_episodes():
    cell, result = record("paper", "policy")
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
    recording = Recording(0, 6, moves, Failure.STUCK, (1, 1, 1, 1, 7), 0.5)
    cell = CellSpec(bin_size=(5, 5, 3), height_unit=0.1)
    data = unpack(replay.page([recording], cell, ""))
    episode = data["episodes"][0]
    assert (data["bin"], episode["height"], episode["waiting"]) == ([5, 5, 0.3], 0.6, [1, 1, 1, 1, 0.7])
    assert [(move[4], move[14]) for move in episode["moves"]] == [(0.3, 0), (0.2, 0.3)]
    assert set(data["colours"]) == {"1,2,0.3", "1,2,0.2", "1,1,0.7"}
    double = unpack(replay.page([recording], CellSpec(height_unit=2.0), ""))
    assert set(double["colours"]) == {"1,2,6", "1,2,4", "1,1,14"}  # written as a browser writes whole numbers


def test_page_of_a_large_tote_is_small():
    rng = np.random.default_rng(0)
    moves = []
    for n in range(4500):  # as many items of two cells as a 30x30x10 tote holds
        z, cell = divmod(n, 450)
        x, y = divmod(cell, 15)
        heat = (rng.random((30, 30)) ** 8 * 255).astype(np.uint8)  # far more detail than a trained policy's
        moves.append(Move((1, 1, 1, 2, 1), (0, 0), (x, 2 * y), 0, (x, 2 * y, 1, 2), z, Failure.NONE, heat))
    recording = Recording(0, 10, moves, Failure.STUCK, (0, 0, 1, 1, 1), 1.0)
    assert len(replay.page([recording], CellSpec(tote_size=(30, 30, 10)), "large")) < 7e6


def test_a_full_tote_is_no_failure():
    full = Recording(0, 1, [Move((0, 0, 2, 2, 1), (0, 0), (0, 0), 0, (0, 0, 2, 2), 0, Failure.NONE)], Failure.STUCK)
    assert full.describe_ending(4) == FULL != full.describe_ending(5)


def test_animation(tmp_path):
    from PIL import Image

    cell, result = record("paper", "joint_dbl")
    replay.animation(result.recordings[0], cell, tmp_path / "replay.gif", seconds=1, frames=4)
    with Image.open(tmp_path / "replay.gif") as image:
        assert image.n_frames == 4 and image.info["loop"] == 0


# ---------------------------------------------------------------------- in a browser
@pytest.fixture(scope="module")
def browser():
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.chrome.service import Service

    driver, chrome = shutil.which("chromedriver"), shutil.which("chromium") or shutil.which("google-chrome")
    if not driver or not chrome:
        pytest.skip("needs chromium and chromedriver, such as Debian's packages chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chrome
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1000,700",
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    window = webdriver.Chrome(options=options, service=Service(driver))
    yield window
    window.quit()


def wait_until(browser, script, seconds=20):
    """Wait until a script returns something true, and return it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := browser.execute_script(f"return {script}"):
            return value
        time.sleep(0.05)
    raise AssertionError(f"never true: {script}; console: {browser.get_log('browser')}")


def open_page(browser, path, fragment=""):
    browser.get("about:blank")
    browser.get_log("browser")
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


def written(tmp_path, recordings, cell):
    path = tmp_path / "replay.html"
    path.write_text(replay.page(recordings, cell, "title"), encoding="utf-8")
    return path


def errors(browser, *levels):
    return [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", *levels)]


def test_page_opens_steps_plays_and_changes_episodes(browser, tmp_path):
    cell, result = record("paper", "policy")
    state = open_page(browser, written(tmp_path, result.recordings, cell), "#episode=0&step=0")
    moves = result.recordings[0].moves
    assert state()["moves"] == len(moves) and state()["shown"] == 0 and not state()["playing"]
    blank = colours_on_canvas(browser)
    assert blank > 5

    click = {name: browser.find_element("id", name).click for name in ("forward", "back", "play", "heat", "view")}
    click["forward"]()
    wait_until(browser, "!replay.state().playing")
    assert state()["at"] == 1 and state()["shown"] == 1
    click["back"]()
    assert state()["at"] == 0
    browser.execute_script("document.getElementById('speed').value = 350")
    click["play"]()
    wait_until(browser, f"replay.state().at === {len(moves)}")
    end = state()
    assert end["shown"] == len(moves) and not end["playing"]
    assert end["ending"] == result.recordings[0].describe_ending(cell.num_places)
    assert abs(float(end["percent"].rstrip("%")) / 100 - result.recordings[0].occupancy) <= 0.001
    assert colours_on_canvas(browser) > blank
    click["heat"]()
    click["view"]()

    browser.execute_script("const e = document.getElementById('episode'); e.value = 2; e.onchange()")
    assert state()["episode"] == 2 and state()["at"] == 0 and state()["moves"] == len(result.recordings[2].moves)
    browser.execute_script("location.hash = '#episode=1&step=2'")
    wait_until(browser, "replay.state().episode === 1 && replay.state().shown === 2")
    assert errors(browser, "WARNING") == []
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert [name for name in fetched if not name.startswith(("data:", "blob:"))] == []


def test_page_of_very_many_moves(browser, tmp_path):
    """More than a function takes arguments."""
    moves = [Move((1, 1, 1, 1, 1 + n % 2), (0, 0), (0, 0), 0, (0, 0, 1, 1), 0, Failure.NONE) for n in range(1500)]
    recordings = [Recording(n, 5, moves, Failure.STUCK, (0, 0, 1, 1, 4), 1.0) for n in range(100)]
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


@pytest.mark.parametrize("cell", ["odd", "mixed"])
def test_page_puts_things_where_they_are(browser, tmp_path, cell):
    """On a tote that is not square, a carried item ends in its footprint, and the heat map on the surface; in cells."""
    cell, result = record(cell, "policy")
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
                for place in range(wide * deep):
                    x, y = divmod(place, deep)
                    assert squares[str(place)] == pytest.approx(
                        [x + 0.5, y + 0.5, unit * heights[x, y] + 0.02], abs=1e-4
                    )
        where = browser.execute_script(
            "const item = scene.children.find(o => o.isGroup && o.children.length === 2 && o.children[0].isMesh);"
            "return [...item.position.toArray(), item.rotation.z]"
        )
        x, y, w, d = move.footprint
        top = move.z + move.item[4]
        assert where[:3] == pytest.approx([x + w / 2, y + d / 2, unit * (move.z + move.item[4] / 2)], abs=0.01)
        assert where[3] == pytest.approx({0: 0, 1: np.pi / 2, 2: np.pi, 3: -np.pi / 2}[move.rotation], abs=1e-6)
        heights[x : x + w, y : y + d] = top
        turns.add(move.rotation)
    assert len(turns) > 1
