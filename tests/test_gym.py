"""The Gymnasium face: other projects' checkers, and the batched environment behind it."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pickplace
from pickplace.views.figures import draw_scene

ID = "pickplace/PickPlace-v0"
SMALL = {"tote_size": (4, 5, 2), "items": [(1, 1, 1), (2, 1, 1), (2, 2, 1)]}


def make(**kwargs):
    return gymnasium.make(ID, **{**SMALL, **kwargs})


@pytest.mark.parametrize("kwargs", [{}, {"bin_size": (4, 6, 2), "effector_size": (2, 3), "rotations": 3}])
def test_gymnasium_checker(kwargs, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*no display.*")
        check_env(make(**kwargs).unwrapped)
        check_env(make(render_mode="rgb_array", **kwargs).unwrapped)


def test_a_recorded_stream_truncates(tmp_path):
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    env = make(items=pickplace.task.items.Recorded(tmp_path / "items.csv"), render_mode="rgb_array")
    _, info = env.reset(seed=0)
    for expected in (False, True):
        _, _, terminated, truncated, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        assert (terminated, truncated) == (False, expected)
    assert env.render().shape == (600, 1200, 3)


def test_render():
    env = make(render_mode="rgb_array")
    _, info = env.reset(seed=0)
    before = env.render()
    env.step(int(np.flatnonzero(info["action_mask"])[0]))
    after = env.render()
    assert before.dtype == np.uint8 and before.shape == after.shape == (600, 1200, 3)
    assert (before != after).any()


def test_an_item_keeps_its_colour_through_an_episode(monkeypatch):
    """Whatever is placed after it."""
    seen = []
    monkeypatch.setattr(
        "pickplace.envs.gymnasium.draw_scene", lambda *given: (seen.append(given[2]), draw_scene(*given))[1]
    )
    env = make(items=[(2, 2, 1), (1, 1, 1)], render_mode="rgb_array")
    _, info = env.reset(seed=0)
    while info["action_mask"].any():
        *_, info = env.step(int(np.flatnonzero(info["action_mask"])[0]))
        env.render()
    assert len(seen) > 2
    assert len({str(colours) for colours in seen}) == 1 and set(seen[0]) == {(1, 1, 1), (2, 2, 1)}


def test_human_mode_without_a_display_says_so(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = make(render_mode="human")
    with pytest.warns(UserWarning, match="there is no display"):
        env.reset(seed=0)
    env.close()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: make(render_mode="ascii"), "render_mode"),
        (lambda: make(masks=()), "masks"),
        (lambda: make(tote_sizes=(1, 1, 1)), "tote_sizes"),
        (lambda: make(rotations=7), "rotations=7"),
        (lambda: make(items=[(9, 9, 9)]), "item 9x9x9"),
        (lambda: make().reset(options={"tote_height": 3}), r"options\['tote_height'\]=3: expected a whole number"),
        (lambda: make().reset(options={"tote_height": 1.5}), r"options\['tote_height'\]=1.5"),
        (lambda: make().reset(options={"height": 1}), r"options\['height'\]: there is no such option"),
        (lambda: make().unwrapped.step(0), "before reset"),
        (lambda: make().unwrapped.render() or make(render_mode="rgb_array").unwrapped.render(), "before reset"),
        (lambda: step_after_reset(make().unwrapped, 10**9), "action=1000000000: expected"),
        (lambda: step_after_reset(make().unwrapped, 0.5), "action=0.5"),
        (lambda: vector(autoreset_mode="Never"), "autoreset_mode='Never'"),
        (lambda: vector(render_mode="human"), "render_mode='human'"),
        (lambda: vector().reset(seed=[1, 2]), r"seed=\[1, 2\]"),
        (lambda: vector().reset(options={"reset_mask": [True]}), "reset_mask"),
        (
            lambda: vector().reset(options={"reset_mask": np.array([True, False])}),
            "reset_mask.* in the first reset: expected none",
        ),
        (lambda: vector().reset(options={"tote_height": [1, 2, 2]}), r"\[1, 2, 2\]"),
        (lambda: vector().step(np.zeros(2, dtype=np.int64)), "before reset"),
        (lambda: step_after_reset(vector(), np.array([0, -1])), "actions="),
        (lambda: step_after_reset(vector(), np.array([0])), "actions="),
        (lambda: step_after_reset(vector(), np.array([0.0, 1.7])), "actions="),
        (lambda: make(seed=5), r"seed=5: expected no such argument; reset\(seed=...\)"),
        (lambda: vector(seed=5), "seed=5: expected no such argument"),
        (lambda: make().reset(seed=2**63), "seed=.*expected a whole number"),
        (lambda: vector().reset(seed=2**63), "seed=.*expected a whole number"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(act, message):
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error), match=message) as caught:
        act()
    assert str(caught.value).count("\n") == 0


def vector(**kwargs):
    return gymnasium.make_vec(ID, num_envs=2, **{**SMALL, **kwargs}).unwrapped


def step_after_reset(env, action):
    env.reset(seed=0)
    env.step(action)


def test_a_picture_shows_its_own_episode():
    env = make(render_mode="rgb_array")
    _, info = env.reset(seed=0)
    empty = env.render()
    env.step(int(np.flatnonzero(info["action_mask"])[0]))
    assert (env.render() != empty).any()
    env.reset(seed=0)
    assert (env.render() == empty).all()


def test_the_picture_of_the_bin_lies_as_the_map_of_the_tote(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "pickplace.envs.gymnasium.draw_scene", lambda *given: seen.append(draw_scene(*given)) or seen[-1]
    )
    env = make(bin_size=(3, 6, 1), render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    env.render()
    image = seen[-1].axes[-1].images[0]
    assert np.array_equal(image.get_array(), observation["bin_depth"].T) and image.origin == "lower"
