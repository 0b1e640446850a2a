"""Boxes under gravity: cases whose outcome is known, and what ends an episode."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from commands import FORKSERVER

from pickplace.physics import simulation
from pickplace.physics.execute import Execute
from pickplace.physics.plans import EpisodePlan, Placement
from pickplace.physics.scene import Scene
from pickplace.physics.settle import Settle
from pickplace.physics.simulation import FINAL_WAIT, Loss, wait

pytest.importorskip("mujoco")
EXACT = Settle(gap=0.0)


def plan(*boxes, tote=(1.0, 1.0, 0.5)):
    """Return a plan of boxes ``(corner, size)``."""
    return EpisodePlan(0, tote, placements=[Placement(corner, size) for corner, size in boxes])


def bricks(*overhangs, length=0.1, height=0.05):
    """Return a stack of equal bricks, each of which is that much further along x than the one below."""
    at = np.cumsum((0.3, *overhangs))
    return plan(*[((x, 0.4, number * height), (length, 0.1, height)) for number, x in enumerate(at)])


@pytest.mark.parametrize(
    ("overhang", "ending"), [(0.3, "done"), (0.49, "done"), (0.51, "collapsed"), (0.7, "collapsed")]
)
@pytest.mark.parametrize("length", [0.06, 0.2])
def test_a_brick_with_half_of_it_in_the_air_falls(overhang, ending, length):
    outcome = EXACT.carry_out_one(bricks(overhang * length, length=length))
    assert (outcome.ending, outcome.lost) == (ending, None if ending == "done" else 1)


@pytest.mark.parametrize(("share", "ending"), [(0.95, "done"), (1.05, "collapsed")])
def test_the_limit_of_the_harmonic_stack(share, ending):
    """The top brick may hang over by a half, the next by a quarter, the one below by a sixth of the length."""
    assert EXACT.carry_out_one(bricks(*(share * 0.1 / part for part in (6, 4, 2)))).ending == ending


@pytest.mark.parametrize(("mass", "ending"), [(0.3, "done"), (0.43, "collapsed"), (0.0, "done")])
def test_a_lever_with_known_masses(mass, ending):
    """A beam of 1 kg has its centre 20 mm inside the edge on which it lies; the load 55 mm outside. Without a mass the
    load has that of the density, 37.5 g."""
    boxes = plan(((0.3, 0.4, 0), (0.12, 0.1, 0.05)), ((0.3, 0.4, 0.05), (0.2, 0.1, 0.05)),
                 ((0.45, 0.4, 0.1), (0.05, 0.05, 0.05)))  # fmt: skip
    _, beam, load = boxes.placements
    boxes.placements[1:] = [replace(beam, mass=1.0), replace(load, mass=mass)]
    assert EXACT.carry_out_one(boxes).ending == ending


@pytest.mark.parametrize(("friction", "slides"), [(0.0, True), (0.15, True), (0.2, False), (0.6, False)])
def test_a_tower_slides_apart_without_friction(friction, slides):
    """On a slope of 10 degrees, whose tangent is 0.176."""
    scene, slope = Scene(friction, 300.0, gap=0.0), np.radians(10)
    scene.add_container((1, 1, 0.5))
    scene.spec.option.gravity = [9.81 * np.sin(slope), 0, -9.81 * np.cos(slope)]
    for placement in bricks(0, 0).placements:
        scene.add(placement.corner, placement.size, placement.centre)
    scene.run(FINAL_WAIT)
    assert (scene.shifts[-1] > 0.02) == slides


def test_an_episode_ends_at_the_first_loss():
    boxes = [
        ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)),
        ((0.07, 0.0, 0.1), (0.1, 0.1, 0.1)),
        ((0.3, 0.3, 0.0), (0.1, 0.1, 0.1)),
    ]
    outcome = EXACT.carry_out_one(plan(*boxes, tote=(0.5, 0.5, 0.5)))
    assert (outcome.ending, outcome.lost, outcome.during, outcome.placed) == ("collapsed", 1, 1, 1)
    assert outcome.occupancy == pytest.approx(0.1**3 / 0.5**3) and outcome.drift < 1e-3
    outcome = EXACT.carry_out_one(plan(*boxes[::2], tote=(0.5, 0.5, 0.5)))
    assert (outcome.ending, outcome.lost, outcome.during, outcome.placed) == ("done", None, None, 2)
    assert outcome.occupancy == pytest.approx(2 * 0.1**3 / 0.5**3)


@pytest.mark.parametrize("method", [Settle(), Execute()], ids=lambda method: method.name)
def test_an_episode_without_placements(method):
    outcome = method.carry_out_one(EpisodePlan(2, (0.3, 0.3, 0.3), (0.25, 0.25, 0.05), (0.15, 0.15)))
    assert (outcome.episode, outcome.ending, outcome.placed, outcome.occupancy) == (2, "done", 0, 0)


@pytest.mark.parametrize("sleep", [False, True])
def test_an_item_that_tilts_slowly_does_not_fall_asleep(sleep):
    """Exactly half of the brick is in the air."""
    assert Settle(gap=0.0, sleep=sleep).carry_out_one(bricks(0.1, length=0.2, height=0.2)).ending == "collapsed"


def test_sleep_changes_no_result_and_processes_neither(monkeypatch):
    """Columns of bricks with random overhangs, some of which fall."""
    monkeypatch.setattr(simulation, "get_context", lambda method: FORKSERVER)  # new processes take seconds to import
    random, plans = np.random.default_rng(0), []
    for episode in range(6):
        plans.append(replace(bricks(*random.uniform(-0.045, 0.045, 5)), episode=episode))
    results = []
    for settings in ({"sleep": False}, {"sleep": True}, {"workers": 2}):
        outcomes = list(Settle(noise=0.001, **settings).carry_out(plans))
        results.append([(one.episode, one.ending, one.lost, one.during, one.occupancy) for one in outcomes])
    assert results[0] == results[1] == results[2]
    assert len({ending for _, ending, *_ in results[0]}) == 2


def test_a_recorded_motion_is_what_happened_and_changes_nothing():
    """A brick lies still after its fall of 2 mm; the next one turns over its edge and falls to the floor."""
    falling = bricks(0.07)
    recorded, bare = EXACT.carry_out_one(falling, record=True), EXACT.carry_out_one(falling)
    motion = recorded.motion
    assert recorded.facts() | {"cpu_seconds": 0} == bare.facts() | {"cpu_seconds": 0} and bare.motion is None
    assert (recorded.ending, recorded.lost, motion.bin, motion.plate) == ("collapsed", 1, None, [])
    assert len(motion.ends) == 2 and motion.ends[1] == motion.pictures
    still, lost = (np.array(poses) for poses in motion.boxes)
    assert still[0] == pytest.approx([0, 0.35, 0.45, 0.027, 1, 0, 0, 0], abs=1e-4)
    assert still[-1, 1:4] == pytest.approx(falling.placements[0].centre, abs=1e-3)
    assert lost[0, 0] == motion.ends[0] and lost[0, 1:4] == pytest.approx([0.42, 0.45, 0.077], abs=1e-4)
    assert lost[-1, 3] < 0.06 and (np.diff(lost[:, 0]) > 0).all()  # the motion goes on to the floor


def test_a_simulation_that_diverges_is_told():
    scene = Scene(0.6, 300.0, gap=0.0)
    scene.add((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), (0.05, 0.05, 0.05))
    scene.data.qvel[:] = np.nan
    scene.run(0.01)
    assert EXACT.find_loss(scene) == ("diverged", 0)


def test_without_mujoco(monkeypatch):
    monkeypatch.setattr(simulation, "mujoco", None)
    with pytest.raises(ValueError, match="physics=settle: MuJoCo is missing"):
        Settle()


def test_a_gap_and_an_error_move_the_boxes():
    scene = Scene(0.6, 300.0, gap=0.004)
    scene.add_container((0.2, 0.2, 0.2))
    scene.add((0.003, 0.0, 0.002), (0.05, 0.05, 0.05), (0.025, 0.025, 0.025))
    wait(scene)
    assert scene.shifts == pytest.approx([0.003], abs=1e-4) and scene.tilts < 0.1
    assert scene.model.geom_size[-1] == pytest.approx([0.023, 0.023, 0.025])
    assert scene.model.body_mass[-1] == pytest.approx(300 * 0.046 * 0.046 * 0.05)


@pytest.mark.parametrize(("key", "value"), [
    ("gap", 0.2), ("friction", -1), ("density", "heavy"), ("gap", float("nan")), ("noise", 1),
    ("max_shift", None), ("max_tilt", 91), ("sleep", 1), ("seed", -1), ("workers", 0),
])  # fmt: skip
def test_impossible_settings_are_refused(key, value):
    with pytest.raises(ValueError, match=f"physics.{key}=.*expected"):
        Settle(**{key: value})


@dataclass(frozen=True)
class Weary(Settle):
    """Drops the second item."""

    name: ClassVar[str] = "weary"

    def place(self, scene, placement, error):
        return Loss("tired", 1) if len(scene.boxes) else super().place(scene, placement, error)


def test_another_scene_is_a_subclass_and_has_losses_of_its_own():
    outcome = Weary().carry_out_one(bricks(0.0), record=True)
    assert (outcome.ending, outcome.lost, outcome.placed, outcome.label) == ("tired", 1, 1, "tired")
    assert outcome.sentence == "Item 2: tired." and len(outcome.motion.boxes) == 1
    done = Settle().carry_out_one(bricks(0.0))
    assert done.sentence.startswith("Carried out") and "motion" not in done.facts() and "sentence" not in done.facts()
