"""Items that may be put down on another side."""

import pytest
import torch
from commands import composed

from pickplace import PickPlaceEnv, Planner
from pickplace.envs.saved_state import check_saved_states
from pickplace.evaluation.evaluate import run
from pickplace.items.distributions import Kinds, search_items
from pickplace.items.orders import Orders
from pickplace.planners.heuristics import JointDBL, RandomFeasible
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.step import apply
from pickplace.runs.checkpoint import CheckpointError

KINDS = [(1, 2, 3), (2, 2, 1), (3, 1, 1), (1, 1, 1)]
CELL = {"tipping": True, "bin_items": 3, "bin_size": (9, 3, 1), "tote_size": (4, 4, 6), "rotations": 2}
CELL |= {"gripper": Overlap((1, 1)), "num_envs": 1}


def contents(env) -> list[tuple[int, int, int]]:
    return [tuple(item[2:]) for item in env.state.items.cuboids[0].tolist() if item[4]]


@pytest.mark.parametrize(("count", "refill"), [(1, "each"), (3, "each"), (2, "batch")])
def test_one_pose_is_taken_and_all_leave(count, refill):
    """The items are those of a cell without tipping, in their order; of each all poses lie in the bin, or none."""
    env = PickPlaceEnv(
        Kinds(KINDS), **{**CELL, "bin_items": 3 * count, "refill": refill, "bin_size": (9, 4 * count, 1)}
    )
    planner, tipped = RandomFeasible(env.cell, seed=1), 0
    for seed in range(6):
        env.set_seed(seed)
        data, waiting, arrived = env.reset(), [], 0
        for _ in range(9):
            lying = contents(env)
            while len(waiting) < len(lying) // 3:
                address = (torch.tensor([number]) for number in (seed, 0, arrived))
                waiting.append(env.items.sample("train", *address, (9, 9)))
                arrived += 1
            sizes = [[int(side) for side in item[2:5]] for item in waiting]
            assert lying == [pose for w, d, h in sizes for pose in ((w, d, h), (w, h, d), (d, h, w))]
            assert arrived == env.arrived and (len(waiting) == count or refill == "batch")
            action = planner.decide(data)
            step = apply(env.cell, env.state, action)
            assert step.item.volume == waiting[int(step.taken) // 3].volume
            tipped += int(step.taken) % 3 > 0
            waiting.pop(int(step.taken) // 3)
            data = env.step(data.set("action", action))["next"]
            if data["done"]:
                break
            assert data["failure"] == 0
    assert tipped > 10


def test_a_tipped_item_fills_what_an_upright_one_cannot():
    """Boxes 2x1x1 in a tote of 3x1x2: two lie on one another, and the third stands beside them."""
    env = PickPlaceEnv(Kinds([(2, 1, 1)]), **{**CELL, "bin_size": (6, 2, 1), "tote_size": (3, 1, 2), "support": "full"})
    data, best = env.reset(), 0
    frontier = [(env.state_dict(), data)]
    while frontier:  # every play
        state, data = frontier.pop()
        for action in data["action_mask"][0].nonzero()[:, 0]:
            env.load_state_dict(state)
            after = env.step(data.set("action", action[None]))["next"]
            best = max(best, int(env.volume))
            if not after["done"]:
                frontier.append(({key: value.clone() for key, value in env.state_dict().items()}, after))
    assert best == 6  # without tipping 4


def test_a_saved_state_has_all_poses_of_its_items():
    env = PickPlaceEnv(Kinds(KINDS), **{**CELL, "num_envs": 8})
    data = env.reset()
    for _ in range(4):
        _, data = env.step_and_maybe_reset(data.set("action", RandomFeasible(env.cell).decide(data)))
    saved = {"environment": {key: value.clone() for key, value in env.state_dict().items()}, "carried": data}
    check_saved_states(env, saved)
    saved["environment"]["item"][3, 2, 2:5] = 1
    with pytest.raises(CheckpointError, match="of no use: item"):
        check_saved_states(env, saved)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bin_items": 4}, "bin_items=4: expected a multiple of 3 with tipping=true"),
        ({"height_unit": 0.5}, "height_unit=0.5: expected 1 with tipping=true"),
        ({"bin_size": (8, 3, 1)}, r"env.bin_size=\[8, 3, 1\]: expected at least 9x3 cells with env.tipping=true"),
        ({"varies": ("bin_items",)}, "env.tipping=true: episodes cannot differ in bin_items then"),
        ({"tipping": 1}, "tipping=1: expected true or false"),
    ],
)
def test_what_does_not_go_with_tipping_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        PickPlaceEnv(Kinds(KINDS), **{**CELL, **changes})


def test_the_first_item_is_considered_in_all_its_poses():
    """The lowest pose of the first of two equal items is the best, and none of the second is taken."""
    cell = {**CELL, "bin_items": 6, "bin_size": (9, 6, 1), "tote_size": (4, 4, 3)}
    env = PickPlaceEnv(Kinds([(1, 2, 3)]), **cell)
    taken = set()
    for seed in range(4):
        env.set_seed(seed)
        data = env.reset()
        for _ in range(4):
            action = JointDBL(env.cell, item="first").decide(data)
            taken.add(int(apply(env.cell, env.state, action).taken))
            data = env.step(data.set("action", action))["next"]
            if data["done"]:
                break
    assert taken <= {0, 1, 2} and 2 in taken


def test_a_gantry_does_not_tip(tmp_path):
    words = ["benchmark=gopt_rs", "env.tipping=true", "env.bin_items=3", "env.bin_size=[15,5,5]", "planner=joint_dbl"]
    cfg = composed(*words, "physics=execute", name="evaluate")
    with pytest.raises(ValueError, match="env.tipping=true: physics=execute carries items with a gripper, which tips"):
        run(cfg, tmp_path / "run")


def test_a_robot_does_not_tip():
    with pytest.raises(ValueError, match="env.tipping=true: a robot's gripper does not tip items"):
        Planner(PickPlaceEnv(Kinds(KINDS), **CELL).cell, planner="joint_dbl")


def test_orders_say_on_which_sides_an_item_may_lie(tmp_path):
    """As they lie and turned: the first may lie on any side, the second upright, the third as it is or on its front."""
    lines = ["length,width,height,weight,orientations", "60,40,20,1,any", "60,40,20,2,upright", "60,40,20,3,lwh hlw"]
    path = tmp_path / "orders.csv"
    path.write_text("\n".join(lines))
    orders = Orders(path, cell_size=0.02, split=False)
    with pytest.raises(ValueError, match="env.handling=false: .*; expected env.handling=true"):
        PickPlaceEnv(orders, stream="test", **CELL)
    env = PickPlaceEnv(orders, stream="test", handling=True, **CELL)
    data, turns = env.reset(), []
    for _ in range(3):
        assert contents(env) == [(3, 2, 1), (3, 1, 2), (2, 1, 3)]
        turns.append(env.state.items.turns[0].tolist())
        data = env.step(data.set("action", data["action_mask"].int().argmax(1)))["next"]
    assert turns == [[0b1111] * 3, [0b1111, 0, 0], [0b0101, 0b1010, 0]] and data["truncated"]
    assert torch.equal(search_items(orders).tipped_turns, orders.tipped_turns)  # a search imagines no other
