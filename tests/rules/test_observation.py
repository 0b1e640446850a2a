"""Observation terms: one of the user's own reaches TorchRL's specs, Gymnasium's space and search alike."""

import re

import gymnasium
import pytest
import torch
from hypothesis import given
from problems import late_state, problems, state_of
from torchrl.envs.utils import check_env_specs

from pickplace import PickPlaceEnv, State
from pickplace.rules.observation import RESERVED, STANDARD_TERMS, Bounds, Term, check_terms, observe


class FreeVolume(Term):
    """Volume of the tote above the heights, int64 ``[N, 1]``."""

    def bounds(self, cell, tallest):
        return Bounds(0, cell.num_places * cell.tote_size[2], (1,), torch.int64)

    def value(self, cell, state):
        return state.tote_height[:, None] * cell.num_places - state.heights.sum((1, 2))[:, None]


class Middle(Term):
    """Depth of the cell in the middle of the tote, float32 ``[N]``; it has no axis of its own."""

    def bounds(self, cell, tallest):
        return Bounds(0, cell.tote_size[2], ())

    def value(self, cell, state):
        return (state.tote_height - state.heights[:, cell.tote_size[0] // 2, cell.tote_size[1] // 2]).float()


OWN = {"free_volume": FreeVolume(), **STANDARD_TERMS, "middle": Middle()}


def test_a_term_of_ones_own_in_torchrl():
    check_env_specs(PickPlaceEnv(observation=OWN, num_envs=3))
    env, observation = late_state(observation=OWN)
    assert list(env.terms) == [*STANDARD_TERMS, "free_volume", "middle"]
    assert torch.equal(observation["free_volume"][:, 0], observation["tote_depth"].sum((1, 2)).long())
    assert torch.equal(observation["middle"], observation["tote_depth"][:, 3, 3])
    spec = env.observation_spec["free_volume"]
    assert (spec.shape, spec.dtype, spec.space.high.max()) == ((16, 1), torch.int64, 180)
    # Only what is asked for is computed.
    assert set(observe(env.terms, env.cell, env.state, ["middle", "tote_depth"]).keys()) == {"middle", "tote_depth"}


def test_a_term_of_ones_own_in_gymnasium():
    env = gymnasium.make("pickplace/PickPlace-v0", observation=OWN)
    space = env.observation_space["free_volume"]
    assert (space.low, space.high, space.shape, space.dtype) == ([0], [180], (1,), "int64")
    assert env.observation_space["middle"].shape == ()
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation) and observation["free_volume"] == 180
    vector = gymnasium.make_vec("pickplace/PickPlace-v0", num_envs=2, observation=OWN)
    observation, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(observation) and observation["middle"].tolist() == [5, 5]


@pytest.mark.parametrize(("bounds", "expected"), [
    (Bounds(0, 9, (), torch.int64), "torch.int64 of shape (2,)"),
    (Bounds(0, 9, (1,)), "torch.float32 of shape (2, 1)"),
])  # fmt: skip
def test_a_value_that_its_bounds_do_not_describe_is_refused(bounds, expected, monkeypatch):
    monkeypatch.setattr(Middle, "bounds", lambda *_: bounds)
    message = f"observation.middle: its value is torch.float32 of shape (2,), expected {expected}, as its bounds say."
    with pytest.raises(ValueError, match=re.escape(message)):
        PickPlaceEnv(observation=OWN, num_envs=2).reset()


@given(problems(count=3))
def test_the_state_can_be_read_from_an_observation(problem):
    cell, cases = problem
    state = state_of(*cases)
    found = State.from_observation(observe(STANDARD_TERMS, cell, state))
    for ours, expected in zip((*found[:2], *found.items), (*state[:2], *state.items), strict=True):
        assert torch.equal(ours, expected)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({**OWN, "middle": 3}, "observation.middle=3: expected a Term, such as"),
        (
            {**OWN, "two words": Middle()},
            r"observation.two words: expected another name; taken are \*_mask, action, ",
        ),
        *(
            ({**OWN, key: Middle()}, f"observation.{key}: expected another name")
            for key in (*RESERVED, "action_mask", "edge_mask", "items", "handling", "level", "coming")
        ),
        ({**STANDARD_TERMS, "tote_depth": Middle()}, "observation.tote_depth=Middle: expected ToteDepth"),
    ],
)
def test_bad_terms_are_refused(terms, message):
    with pytest.raises(ValueError, match=message):
        PickPlaceEnv(observation=terms)
    assert check_terms(None) == dict(STANDARD_TERMS)
    assert list(check_terms({"middle": Middle()})) == [*STANDARD_TERMS, "middle"]
