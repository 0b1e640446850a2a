"""Measure the time of every answer that a robot gets, on one core: python benchmarks/answers.py [checkpoint ...]

Each shipped checkpoint fills totes of its own cell with its own items, until nothing fits (stuck). Every state is
planned in cells and in metres, with ten alternatives, and once more by a planner with one candidate (rejected). So are
an item that fits in no tote (impossible), and a bin whose item is no cuboid (refused). The first plan after loading
counts, too. The time from images to a scene is measured separately.
"""

import sys
import time
from collections import Counter

import numpy as np
import torch
from common import ROOT, save, use_one_core

from pickplace.policies.restore import load_policy
from pickplace.robot.box import DepthMapError
from pickplace.robot.planner import Planner
from pickplace.robot.scene import Scene
from pickplace.rules.cell import CellSpec
from pickplace.views.recording import items_in_bin

EPISODES = 2


def maps_of(env) -> dict[str, np.ndarray | float]:
    """Return the maps of bin and tote of an environment with one slot, in whole cells."""
    state = env.state
    bin_depth, labels = np.zeros((2, *env.cell.bin_size[:2]), dtype=int)
    for number, (x, y, w, d, h) in enumerate(items_in_bin(state.items, 0), 1):
        bin_depth[x : x + w, y : y + d], labels[x : x + w, y : y + d] = h, number
    height = int(state.tote_height)
    bearing = (state.surface[0] & 1).numpy()
    return {
        "bin_depth": bin_depth, "bin_labels": labels, "tote_depth": height - state.heights[0].numpy(),
        "tote_height": height, "tote_bearing": bearing,
    }  # fmt: skip


def in_metres(maps: dict, cell: CellSpec) -> dict:
    """Return the same scene in metres."""
    lengths = {key: maps[key] * cell.height_unit * cell.cell_size for key in ("bin_depth", "tote_depth", "tote_height")}
    return {**maps, **lengths, "cell_size": cell.cell_size}


def scenes(planner: Planner, env):
    """Yield the maps of every state of some episodes; after each episode, also maps of too high an item, and of an
    item that is no cuboid."""
    for episode in range(EPISODES):
        env.set_seed(episode)
        data = env.reset()
        yield (maps := maps_of(env))
        while (plan := planner.plan(Scene.from_maps(**maps), alternatives=0)).action is not None:
            data = env.step(data.set("action", torch.tensor([plan.action])))["next"]
            yield (maps := maps_of(env))
        yield {**maps, "bin_depth": np.where(maps["bin_depth"] > 0, maps["tote_height"] + 1, 0)}
        uneven = maps["bin_depth"].copy()
        uneven[0, 0] += 1
        yield {**maps, "bin_depth": uneven}


def answer(planner: Planner, maps: dict) -> tuple[str, float]:
    """Return the status of a plan and the milliseconds that it took."""
    begin = time.perf_counter()
    try:
        status = planner.plan(Scene.from_maps(**maps)).status
    except DepthMapError:
        status = "refused"
    return status, 1000 * (time.perf_counter() - begin)


def row(path: str) -> dict:
    """Return percentiles of the times of one checkpoint's answers, and the count of each status."""
    env = load_policy(path).make_env(num_envs=1)
    planners = {"all": Planner.load(path), "one candidate": Planner.load(path, candidates=1)}
    found: dict[str, list] = {name: [] for name in planners}
    for maps in scenes(planners["all"], env):
        for name, planner in planners.items():
            found[name] += [answer(planner, each) for each in (maps, in_metres(maps, env.cell))]
    return {name: summary(answers) for name, answers in found.items()}


def images(count: int = 40) -> dict:
    """Return percentiles of the time from two depth images of 640 x 480 pixels to a scene, or to its refusal.

    The images are those of ``tests/long/camera_truth.py``, good and bad ones.
    """
    sys.path.insert(0, str(ROOT / "tests/long"))
    import camera_truth as truths

    found = []
    for seed in range(90_000, 90_000 + count):
        draw = np.random.default_rng(seed)
        cell, kind = str(draw.choice(list(truths.CELLS))), str(draw.choice(truths.KINDS))
        views, _ = truths.images(draw, truths.random_truth(draw, cell, kind), kind)
        spec, side, rim, _ = truths.CELLS[cell]
        begin, status = time.perf_counter(), "seen"
        try:
            Scene.from_images(spec, *views, side, truths.ACCURACY, tote_height=rim)
        except DepthMapError:
            status = "refused"
        found.append((status, 1000 * (time.perf_counter() - begin)))
    return summary(found)


def summary(answers: list[tuple[str, float]]) -> dict:
    times = np.array([ms for _, ms in answers])
    median, most = np.percentile(times, [50, 95])
    return {
        "median ms": median, "95% ms": most, "greatest ms": times.max(), "slowest": answers[times.argmax()][0],
        "statuses": dict(Counter(status for status, _ in answers)),
    }  # fmt: skip


def main() -> None:
    names = sys.argv[1:] or sorted(folder.name for folder in (ROOT / "pickplace/pretrained").iterdir())
    use_one_core()
    save("answers", {"images": images(), "rows": {name: row(f"pretrained/{name}") for name in names}})


if __name__ == "__main__":
    main()
