"""Pictures of the Gymnasium environment."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pickplace.rules.gripper.rules import Overlap
from pickplace.views import gymnasium as module
from pickplace.views.scene import draw_scene

ITEMS = [(2, 2, 1), (1, 1, 1)]


def make(**settings):
    settings = {"tote_size": (4, 5, 2), "items": ITEMS, "render_mode": "rgb_array", **settings}
    env = gymnasium.make("pickplace/PickPlace-v0", **settings)
    return env, lambda info: env.step(int(np.flatnonzero(info["action_mask"])[0]))[-1]  # makes a feasible action


@pytest.fixture
def scenes(monkeypatch):
    """The arguments and the figure of each scene that is drawn."""
    drawn = []

    def draw(*given):
        drawn.append((*given, draw_scene(*given)))
        return drawn[-1][-1]

    monkeypatch.setattr(module, "draw_scene", draw)
    return drawn


def test_a_picture_shows_its_own_episode():
    env, place = make()
    _, info = env.reset(seed=0)
    empty = env.render()
    place(info)
    after = env.render()
    assert empty.dtype == np.uint8 and empty.shape == after.shape == (600, 1200, 3) and (empty != after).any()
    env.reset(seed=0)
    assert (env.render() == empty).all()
    check_env(env.unwrapped)


def test_an_item_keeps_its_colour_through_an_episode(scenes):
    """Whatever is placed after it; and the last picture says how the episode ended."""
    env, place = make()
    _, info = env.reset(seed=0)
    while info["action_mask"].any():
        info = place(info)
        env.render()
    colours = [colours for _, _, colours, _ in scenes]
    assert len(colours) > 2 and all(found == colours[0] for found in colours) and set(colours[0]) == {*ITEMS}
    assert scenes[-1][-1].get_suptitle().endswith(("fits nowhere any more.", "The tote is full."))


def test_the_bin_lies_as_the_height_map(scenes):
    env, _ = make(bin_size=(3, 6, 1))
    observation, _ = env.reset(seed=0)
    env.render()
    image = scenes[-1][-1].axes[-1].images[0]
    assert np.array_equal(image.get_array(), observation["bin_depth"].T) and image.origin == "lower"


def test_several_items_in_the_bin_are_outlined(scenes):
    env, place = make(bin_size=(5, 6, 1), bin_items=3, items=[(2, 2, 1), (1, 1, 2)])
    _, info = env.reset(seed=0)
    while info["action_mask"].any():
        env.render()
        lying = [tuple(item[:5]) for item in env.unwrapped._env.item[0].tolist() if item[4]]
        inset = scenes[-1][-1].axes[-1]
        found = [(p.get_x() + 0.5, p.get_y() + 0.5, p.get_width(), p.get_height()) for p in inset.patches]
        assert len(lying) > 1 and found == [item[:4] for item in lying]
        for x, y, w, d, h in lying:
            assert (inset.images[0].get_array()[y : y + d, x : x + w] == h).all()
        info = place(info)
    env.render()
    assert scenes[-1][-1].get_suptitle().endswith("None of these items fits anywhere any more.")


def test_a_tipped_item_has_a_colour():
    cell = {"tote_size": (4, 5, 4), "bin_size": (9, 3, 3), "bin_items": 3, "rotations": 1, "tipping": True}
    env, _ = make(**cell, items=[(1, 2, 3)], gripper=Overlap(size=(1, 1)))
    _, info = env.reset(seed=5)
    for choice in (0, -1, 0, -1):  # upright, and tipped
        info = env.step(int(np.flatnonzero(info["action_mask"])[choice]))[-1]
        assert env.render().ndim == 3


def test_human_mode_without_a_display_warns(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env, _ = make(render_mode="human")
    with pytest.warns(UserWarning, match="there is no display"):
        env.reset(seed=0)
    env.close()


def test_a_picture_before_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        make()[0].unwrapped.render()


def test_a_refused_step_is_not_drawn():
    env, place = make()
    _, info = env.reset(seed=0)
    *_, info = env.step(int(np.flatnonzero(info["action_mask"] == 0)[0]))  # ends the episode
    last = env.render()
    with pytest.raises(gymnasium.error.ResetNeeded, match="have ended"):
        place(info)
    assert (env.render() == last).all()
