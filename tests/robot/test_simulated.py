"""A cell in MuJoCo, end to end: depth images with noise, the camera code, the planner, the gantry."""

import sys
from pathlib import Path

import numpy as np
import pytest

from pickplace import CellSpec, Planner

pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))

from simulated_cell import SimulatedCell  # noqa: E402

SIZES = {"tote_size": (6, 6, 5)}


def draw_items(seed: int, sizes) -> list:
    """Sixty items somewhere in the bin, turned at random, as high as its walls or higher."""
    draw, items = np.random.default_rng(seed), []
    for _ in range(60):
        w, d, h = draw.uniform(*sizes)
        turn = draw.uniform(-np.pi, np.pi)
        cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
        half = np.array((w * cos + d * sin, w * sin + d * cos)) / 2 + 0.001
        items.append(((w, d, h), tuple(draw.uniform(half, 0.25 - half)), np.degrees(turn)))
    return items


BOXES = [(0.12, 0.08, 0.06), (0.12, 0.08, 0.06)]
ANY = [(0.04, 0.04, 0.06), (0.135, 0.135, 0.1)]


def fill(planner: Planner, seed: int, sizes) -> float:
    """The filled share of a tote that is filled until an item finds no place."""
    filled = SimulatedCell(planner, seed=seed).fill(draw_items(seed, sizes))
    assert filled.loss is None and filled.last.status == "stuck", (seed, filled)
    return filled.volume / np.prod((0.3, 0.3, 0.25))


@pytest.mark.parametrize(("seed", "sizes"), [
    (0, BOXES), pytest.param(1, ANY, marks=pytest.mark.slow),
])  # fmt: skip
def test_a_gantry_fills_a_tote_by_what_cameras_see(seed, sizes):
    """``slow`` fills 20 totes."""
    assert fill(Planner.load("pretrained/mixed", **SIZES), seed, sizes) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sizes", [BOXES, ANY])
@pytest.mark.parametrize("name", ["pretrained/mixed", "joint_dbl"])
def test_a_gantry_fills_20_totes(name, sizes):
    planner = Planner(CellSpec(**SIZES), planner=name) if name == "joint_dbl" else Planner.load(name, **SIZES)
    assert np.mean([fill(planner, seed, sizes) for seed in range(20)]) > 0.15


def test_an_item_that_the_gripper_does_not_reach_is_lost():
    """The test above can fail: a camera that sees items 2 cm too high."""
    cell = SimulatedCell(Planner(CellSpec(**SIZES), planner="joint_dbl"))
    measure = cell.depth_image
    cell.depth_image = lambda name: (depth := measure(name)) - 0.02 * (name == "bin") * (depth < 1.17)
    filled = cell.fill(draw_items(0, BOXES))
    assert filled.loss is not None and filled.loss.reason == "dropped"
