"""A gantry carries items: what it must touch is told, and what the rules call feasible it carries out."""

from dataclasses import replace

import numpy as np
import pytest

from pickplace import PickPlaceEnv
from pickplace.evaluation.play import play
from pickplace.items.distributions import Uniform
from pickplace.physics.execute import Execute
from pickplace.physics.plans import EpisodePlan, Placement
from pickplace.physics.recorded import plan_of
from pickplace.physics.settle import Settle
from pickplace.planners.heuristics import RandomFeasible
from pickplace.views.motion import Motion

pytest.importorskip("mujoco")
BIN, EFFECTOR = (0.25, 0.25, 0.05), (0.15, 0.15)


def carry(*placements, tote=(0.3, 0.3, 0.25), **settings):
    return Execute(**settings).carry_out_one(EpisodePlan(0, tote, BIN, EFFECTOR, list(placements)))


def placed(corner, size, ahead=(0.0, 0.0)):
    """Return the placement of an item below the middle of the plate, or of a plate that is further along."""
    middle = [side / 2 + step for side, step in zip(size, ahead, strict=False)]
    pick, place = ([at + half for at, half in zip(start, middle, strict=False)] for start in ((0.1, 0.1), corner))
    return Placement(corner, size, (0.1, 0.1), tuple(pick), tuple(place), 0)


TALL, LOW = ((0.0, 0.1, 0.0), (0.1, 0.1, 0.1)), ((0.1, 0.1, 0.0), (0.1, 0.1, 0.05))


@pytest.mark.parametrize(("placements", "ending", "during"), [
    ([placed(*TALL, (0.03, 0)), placed(*LOW, (0.026, 0))], "done", None),  # a millimetre beside the tall one
    ([placed(*TALL, (0.03, 0)), placed(*LOW, (0.02, 0))], "effector_contact", 1),  # 5 mm over the tall one
    ([placed(*TALL)], "effector_contact", 0),  # over the wall, below the rim
    ([placed((0.0, 0.1, 0.0), (0.1, 0.1, 0.25))], "done", None),  # over the wall, level with it
    ([replace(placed(*LOW), pick=(0.0, 0.0))], "dropped", 0),  # the plate is not above the item
    ([replace(placed(*LOW), place=(0.16, 0.15))], "wedged", 0),  # a centimetre beside where it was planned
    ([replace(placed(*LOW), mass=3.0)], "done", None),  # the suction bears 100 N, and also accelerates it
    ([replace(placed(*LOW), mass=11.0)], "dropped", 0),
])  # fmt: skip
def test_cases_by_hand(placements, ending, during):
    outcome = carry(*placements)
    assert (outcome.ending, outcome.during, outcome.lost) == (ending, during, during)
    assert outcome.placed == (len(placements) if during is None else during) and outcome.drift < 1e-3


@pytest.mark.parametrize(("body", "rotation", "ending"), [
    ((), 0, "effector_contact"),
    (((0.05, 0.0, 0.1, 0.15),), 0, "done"),  # without the cells above the tall item
    (((0.0, 0.0, 0.1, 0.15),), 0, "effector_contact"),
    (((0.05, 0.0, 0.1, 0.15),), 180, "effector_contact"),
    (((0.0, 0.0, 0.1, 0.15),), 180, "done"),
    (((0.05, 0.0, 0.1, 0.15), (0.0, 0.0, 0.05, 0.05)), 0, "effector_contact"),  # an L
])  # fmt: skip
def test_only_the_body_hits_what_is_below_it(body, rotation, ending):
    """The plate hangs 5 mm over the tall item."""
    low = placed(*LOW, (0.02, 0))
    if rotation == 180:  # picked on the other side, so that the plate is in the same place
        low = replace(low, pick=(0.13, 0.15), rotation=180)
    placements = [placed(*TALL, (0.03, 0)), low]
    assert Execute().carry_out_one(EpisodePlan(0, (0.3, 0.3, 0.25), BIN, EFFECTOR, placements, body)).ending == ending


@pytest.mark.parametrize(("ahead", "diameter", "ending"), [
    ((0.02, 0.0), None, "effector_contact"), ((0.02, 0.0), 0.15, "effector_contact"), ((0.02, 0.0), 0.13, "done"),
    ((0.012, 0.02), None, "effector_contact"), ((0.012, 0.02), 0.15, "done"),  # only a corner is over the tall item
])  # fmt: skip
def test_a_round_plate_is_narrower_than_its_cells(ahead, diameter, ending):
    low = ((0.1, 0.1, 0.0), (0.1, 0.1, 0.05)) if not ahead[1] else ((0.1, 0.12, 0.0), (0.1, 0.1, 0.05))
    tall = TALL if not ahead[1] else ((0.0, 0.0, 0.0), (0.1, 0.12, 0.1))
    outcome = carry(placed(*tall, (0.03, 0.06)), placed(*low, ahead), tote=(0.3, 0.4, 0.25), plate_diameter=diameter)
    assert outcome.ending == ending


def test_a_round_plate_must_fit_its_cells():
    with pytest.raises(ValueError, match="physics.plate_diameter=0.2: .* 0.15"):
        carry(placed(*LOW), plate_diameter=0.2)
    with pytest.raises(ValueError, match="physics.plate_diameter='x': "):
        Execute(plate_diameter="x")


@pytest.mark.parametrize(("suction", "ending"), [(2.0, "dropped"), (50.0, "done")])
def test_a_heavy_item_needs_suction(suction, ending):
    """0.1 x 0.1 x 0.05 m of 2,000 kg/m^3 weigh 9.8 N."""
    assert carry(placed(*LOW), density=2000.0, suction=suction).ending == ending


def test_contacts_are_damped_as_asked():
    plan = EpisodePlan(0, (0.3, 0.3, 0.25), BIN, EFFECTOR, [placed(*LOW)])
    scene = Execute(contact_damping=2.0).make_scene(plan)
    scene.add((0.1, 0.1, 0.0), (0.1, 0.1, 0.05), np.zeros(3))
    assert len(scene.model.geom_solref) > 10 and (scene.model.geom_solref[:, 1] == 2.0).all()
    assert Execute(contact_damping=2.0).carry_out_one(plan).ending == "done"


def test_a_light_contact_does_not_count():
    heavy_handed = [placed(*TALL, (0.03, 0)), placed(*LOW, (0.02, 0))]  # 5 mm over the tall one
    assert carry(*heavy_handed, contact_force=1e5).ending != "effector_contact"


def test_plans_without_a_bin_are_refused():
    with pytest.raises(ValueError, match="episode 3 has no bin"):
        Execute().carry_out_one(EpisodePlan(3, (0.3, 0.3, 0.3), placements=[Placement((0, 0, 0), (0.1, 0.1, 0.1))]))


@pytest.mark.parametrize("count", [2, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("settings", [
    {},
    pytest.param({"effector_size": (3, 2), "bin_size": (4, 5, 2)}, marks=pytest.mark.slow),
    {"effector_size": (6, 5), "tote_size": (6, 6, 1)},
    {"pick_rule": "overlap", "bin_size": (5, 5, 3), "effector_size": (2, 2)},
    pytest.param({"pick_rule": "seal", "effector_size": (1, 1)}, marks=pytest.mark.slow),
    pytest.param({"pick_rule": "seal", "min_seal": 0.25, "cup": [[1, 0, 1], [0, 0, 0], [1, 0, 1]]},
                 marks=pytest.mark.slow),
    {"pick_rule": "seal", "min_seal": 0.5, "body": [[1, 1, 1], [1, 0, 0]], "cup": [[1, 1, 0], [0, 0, 0]],
     "effector_size": (2, 3)},
    {"bin_items": 3, "bin_size": (6, 5, 1), "items": Uniform((1, 2), (1, 3), (1, 2))},
])  # fmt: skip
def test_what_the_rules_call_feasible_is_carried_out(settings, count):
    """Random play with every rotation and grasp: each item comes to lie where the rules say."""

    def make_env(first, count):
        return PickPlaceEnv(
            num_envs=count, support="more_than_half", first_episode=first, **{"tote_size": (5, 4, 2), **settings}
        )

    cell = make_env(0, 1).cell
    episodes = play(make_env, RandomFeasible(cell, seed=1), count, count, record=range(count))
    plans = [plan_of(recording, cell) for recording in episodes.recordings]
    assert {placement.rotation for plan in plans for placement in plan.placements} == {0, 90, 180, 270}
    for outcome, plan, occupancy in zip(Execute().carry_out(plans), plans, episodes.occupancy, strict=True):
        assert (outcome.ending, outcome.placed) == ("done", len(plan.placements)), outcome
        assert outcome.occupancy == pytest.approx(float(occupancy)) and outcome.drift < 1e-3


def beside(x, height, depth=0.1):
    """Return the first item of these tests beside another item in the bin, 5 cm wide, that begins at ``x``."""
    return replace(placed(*LOW, (0.025, 0)), neighbours=((x, 0.1, 0.05, depth, height),))


@pytest.mark.parametrize(("placement", "ending"), [  # the item lies at 0.1 to 0.2 m, and the plate hangs at 0.1 to 0.25
    (beside(0.2, 0.05), "effector_contact"),  # level with the item: the lip would suck it, too
    (beside(0.2, 0.1), "effector_contact"),  # higher
    (beside(0.2, 0.04), "done"),  # lower
    (beside(0.2, 0.048), "done"),
    (beside(0.05, 0.05), "done"),  # level and side by side, but not below the plate
    (beside(0.05, 0.1), "done"),
    (beside(0.186, 0.04), "disturbed"),  # in the item by 14 mm: they push each other out of the way
])  # fmt: skip
def test_neighbours_in_the_bin(placement, ending):
    outcome = Execute().carry_out_one(EpisodePlan(0, (0.3, 0.3, 0.25), (0.3, 0.3, 0.05), EFFECTOR, [placement]))
    assert (outcome.ending, outcome.placed) == (ending, int(ending == "done"))
    alone = replace(placement, neighbours=())
    plans = [EpisodePlan(0, (0.3, 0.3, 0.25), placements=[one]) for one in (placement, alone)]
    settled = [replace(Settle().carry_out_one(plan), cpu_seconds=0) for plan in plans]
    assert settled[0] == settled[1] and settled[0].ending == "done"


A, B, C = (0.0, 0.0, 0.1, 0.05, 0.05), (0.1, 0.0, 0.1, 0.1, 0.04), (0.0, 0.1, 0.05, 0.1, 0.03)


def test_an_item_waits_in_the_bin_until_it_is_taken():
    """B lies there from the first pick on and is taken second; C comes with the second pick and stays."""
    first = Placement((0.1, 0.1, 0.0), A[2:], A[:2], (0.075, 0.075), (0.175, 0.175), 0, (B,))
    near = (0.1 + 1e-9, *B[1:2])  # written by another program
    second = Placement((0.1, 0.2, 0.0), B[2:], near, (0.15, 0.05), (0.15, 0.25), 0, (C,), 1.5)
    plan = EpisodePlan(0, (0.4, 0.4, 0.25), (0.25, 0.25, 0.02), EFFECTOR, [first, second])
    execute = Execute()
    scene = execute.make_scene(plan)
    start = scene.bin
    scene.motion = Motion(tuple(start))
    assert execute.place(scene, first, np.zeros(2)) is None
    (waiting,) = scene.waiting.values()
    assert len(scene.bodies) == 2 and np.allclose(
        scene.data.xpos[waiting.id], (*(start + (0.15, 0.05)), 0.02), atol=1e-4
    )
    assert execute.place(scene, second, np.zeros(2)) is None
    assert len(scene.bodies) == 3 and scene.boxes[1].name == waiting.name
    assert np.allclose(scene.data.xpos[waiting.id], (0.15, 0.25, 0.02), atol=1e-3) and list(scene.waiting) == [C]
    assert scene.model.body_mass[[body.id for body in scene.boxes]] == pytest.approx([0.075, 1.5], rel=0.05)  # own mass

    motion = execute.carry_out_one(plan, record=True).motion
    a, b, c = motion.boxes
    assert motion.left == [C[2:]] and len(motion.ends) == 2
    for poses, box in zip(motion.boxes, (A, B, C), strict=True):
        assert np.allclose(poses[0][1:4], (*(start + box[:2] + np.divide(box[2:4], 2)), box[4] / 2), atol=1e-4)
    assert a[0][0] <= 1 and b[0][0] <= 1 and motion.ends[0] <= c[0][0] <= motion.ends[0] + 1 and len(c) == 1
    assert b[1][0] > motion.ends[0] and np.allclose(
        b[-1][1:4], (0.15, 0.25, 0.02), atol=1e-3
    )  # not before its own turn


def test_a_neighbour_hardly_wider_than_the_gap_is_refused():
    plan = EpisodePlan(4, (0.3, 0.3, 0.25), (0.3, 0.3, 0.05), EFFECTOR, [beside(0.2, 0.05, 0.0015)])
    with pytest.raises(ValueError, match="episode 4, a neighbour of item 1: 0.0015 m wide"):
        Execute().carry_out_one(plan)


def test_errors_of_placement_reach_the_tote():
    boxes = [placed((0.1, 0.1, 0.0), (0.05, 0.05, 0.05)), placed((0.2, 0.2, 0.0), (0.05, 0.05, 0.05))]
    exact, noisy = (carry(*boxes, noise=noise, tote=(0.4, 0.4, 0.25)) for noise in (0.0, 0.003))
    errors = 0.003 * np.random.default_rng((0, 0)).standard_normal((2, 2))
    assert exact.drift < 1e-4 and noisy.drift == pytest.approx(np.linalg.norm(errors, axis=1).max(), abs=2e-4)


def test_sleep_changes_no_result():
    plan = [placed(*TALL, (0.03, 0)), placed(*LOW, (0.026, 0)), placed((0.1, 0.1, 0.05), (0.1, 0.1, 0.05), (0.026, 0))]
    awake, asleep = (carry(*plan, sleep=sleep) for sleep in (False, True))
    assert replace(awake, drift=0, cpu_seconds=0) == replace(asleep, drift=0, cpu_seconds=0)
    assert awake.drift == pytest.approx(asleep.drift, abs=1e-5)
