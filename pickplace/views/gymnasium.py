"""The Gymnasium environment with pictures, as ``gymnasium.make("pickplace/PickPlace-v0")`` returns it."""

import os
import sys
from typing import Any

import gymnasium
import numpy as np
import torch

from pickplace.common.validate import expect
from pickplace.envs.gymnasium import PickPlaceGymEnv
from pickplace.items.tipping import sizes_in_bin
from pickplace.rules.item import bin_depth_from_items
from pickplace.rules.state import Failure
from pickplace.views.figures import INK
from pickplace.views.recording import Recording, items_in_bin, record_moves
from pickplace.views.scene import draw_scene, item_colours

WINDOW = "pickplace"  # title of the window of mode human


class RenderedPickPlaceEnv(PickPlaceGymEnv):
    """:class:`~pickplace.envs.gymnasium.PickPlaceGymEnv` with rendering.

    Args:
        items: an item distribution, or a list of ``(w, d, h)``.
        render_mode: ``"rgb_array"``, ``"human"`` (a window) or None.
        **settings: see :class:`~pickplace.envs.torchrl.PickPlaceEnv`.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 4}

    def __init__(self, items=None, render_mode: str | None = None, **settings):
        expect(render_mode in (None, "rgb_array", "human"), "render_mode", render_mode, "'rgb_array', 'human' or None")
        super().__init__(items, **settings)
        self.render_mode = render_mode
        self._recording: Recording | None = None  # of the running episode
        self._colours = item_colours(sizes_in_bin(self._env.cell, self._env.items).tolist()) if render_mode else {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        result = super().reset(seed=seed, options=options)
        if self.render_mode:
            self._recording = Recording(int(self._env.episode[0]), int(self._env.tote_height[0]))
        self._update_window()
        return result

    def step(self, action):
        env, moves = self._env, []
        if self._recording is not None and self.action_space.contains(action):
            moves = record_moves(env.cell, None, None, env.state, torch.as_tensor([int(action)], device=env.device))
        *result, terminated, truncated, info = super().step(action)  # may refuse the action; changes the state in place
        if self._recording is not None:
            self._recording.moves += moves
            if terminated or truncated:
                self._recording.ending = Failure[info["failure"].upper()]
                self._recording.waiting = items_in_bin(env.state.items, 0)
        self._update_window()
        return *result, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        return self._picture() if self.render_mode == "rgb_array" else None  # the window is kept up to date

    def _picture(self) -> np.ndarray:
        """Return a picture of the tote in 3D, the tote's height map and the bin, uint8 ``[600, 1200, 3]``."""
        from matplotlib.patches import Rectangle

        if self._recording is None:
            raise gymnasium.error.ResetNeeded("render() before reset().")
        cell, items = self._env.cell, self._env.state.items
        scene = draw_scene(self._recording, cell, self._colours)
        inset = scene.add_axes((0.01, 0.04, 0.09, 0.18))
        bin_depth = bin_depth_from_items(items, cell.bin_size)[0].cpu().numpy()
        inset.imshow(bin_depth.T, origin="lower", cmap="YlOrBr", vmin=0)
        for x, y, w, d, _ in items_in_bin(items, 0):  # outlines separate items that lie side by side
            inset.add_patch(Rectangle((x - 0.5, y - 0.5), w, d, fill=False, edgecolor=INK, linewidth=1))
        inset.set_title("bin", fontsize="medium")
        inset.set(xticks=[], yticks=[])
        scene.set_dpi(100)
        scene.canvas.draw()
        return np.asarray(scene.canvas.buffer_rgba())[..., :3].copy()

    def _update_window(self) -> None:
        if self.render_mode != "human":
            return
        if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            from matplotlib import pyplot

            pyplot.figure(WINDOW, figsize=(12, 6), dpi=100, clear=True).figimage(self._picture())
            pyplot.pause(1 / self.metadata["render_fps"])
        else:
            gymnasium.logger.warn("render_mode='human': there is no display, so no window is shown; try 'rgb_array'.")

    def close(self) -> None:
        if self.render_mode == "human":
            from matplotlib import pyplot

            pyplot.close(WINDOW)
