"""The planners' protocol: what ``decide`` may return is checked in training, evaluation and on the robot."""

import pytest
import torch
from untrained import untrained_policy

from pickplace import CellSpec, PickPlaceEnv, Planner, Scene
from pickplace.evaluation.play import decision_latency, play
from pickplace.planners.heuristics import JointDBL
from pickplace.planners.use import decide


class Wrong:
    """``joint_dbl``, whose return is changed by a function."""

    name = "wrong"

    def __init__(self, cell, change):
        self.inner, self.change = JointDBL(cell), change

    def decide(self, observation):
        return self.change(self.inner.decide(observation))


WRONG = {  # what becomes of int64 [N], and what the sentence says of it
    "float32 of shape [4]": lambda action: action.float(),
    "int32 of shape [4]": lambda action: action.int(),
    "bool of shape [4]": lambda action: action > 0,
    "int64 of shape [4, 1]": lambda action: action[:, None],
    "int64 of shape []": lambda action: action[0],
    "int64 of shape [3]": lambda action: action[1:],
    "NoneType": lambda action: None,
    "list": lambda action: action.tolist(),
    "ndarray of int64": lambda action: action.numpy(),
    "action -1": lambda action: action.fill_(-1),
    "action 3600": lambda action: action.index_fill_(0, torch.tensor([2]), 3600),
}


@pytest.mark.parametrize("found", WRONG)
def test_a_wrong_return_of_decide_is_named(found):
    env = PickPlaceEnv(num_envs=4)
    observation = env.reset()
    right = JointDBL(env.cell).decide(observation)
    assert torch.equal(decide(Wrong(env.cell, torch.clone), env.cell, observation), right)
    with pytest.raises(ValueError) as error:
        decide(Wrong(env.cell, WRONG[found]), env.cell, observation)
    wanted = "expected a tensor of flat actions, int64 of shape [4], from 0 to 3599"
    assert str(error.value) == f"Wrong.decide returned {found}: {wanted}."


def test_a_planner_that_fails_is_named():
    """But its own sentence stays, and the cause."""
    env = PickPlaceEnv(num_envs=4)
    with pytest.raises(ValueError, match=r"^Wrong.decide failed: ZeroDivisionError: .* by zero") as caught:
        decide(Wrong(env.cell, lambda action: 1 // 0), env.cell, env.reset())
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    with pytest.raises(ValueError, match="^invalid literal"):
        decide(Wrong(env.cell, lambda action: int("x")), env.cell, env.reset())


def ask_robot(planner):
    robot, item = Planner(CellSpec(), untrained_policy(CellSpec())), torch.zeros(5, 5)
    item[0, 0] = 1
    robot._planners[1, 0] = planner
    planner.choose = lambda cell, state, maps, observation: planner.decide(observation)
    planner.restart = lambda: None
    robot.plan(Scene.from_maps(item, torch.full((6, 6), 5)), alternatives=0)


@pytest.mark.parametrize(
    "ask",
    [
        lambda planner: play(lambda first, count: PickPlaceEnv(num_envs=count), planner, 2, 2),
        lambda planner: decision_latency(lambda first, count: PickPlaceEnv(num_envs=count), planner, 1),
        ask_robot,
    ],
)
@pytest.mark.parametrize("change", [torch.Tensor.float, lambda action: action[:, None], lambda action: None])
def test_everyone_who_asks_a_planner_checks_its_answer(ask, change):
    with pytest.raises(ValueError, match=r"\.decide returned .*: expected a tensor of flat actions, int64"):
        ask(Wrong(CellSpec(), change))
