"""Gymnasium environments over :class:`~pickplace.envs.torchrl.PickPlaceEnv`: one problem, or many side by side."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict

from pickplace.common.validate import expect
from pickplace.envs.episode import RESET_ENTRIES
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.items.distributions import check_seed
from pickplace.rules.state import Failure

INFO = ("occupancy", "failure", "action_mask")


class PickPlaceGymEnv(gymnasium.Env):
    """
    ## Description
    A suction robot takes items one by one from a bin and packs them into a tote. The grip decides where an item can be
    set down: the end effector must hit neither the tote's walls nor the items inside. Pick cell, place cell and
    rotation are one action. See *Simultaneous Planning for Item Picking and Placing by Deep Reinforcement
    Learning* (Tanaka et al., IROS 2020).

    ## Action Space
    `Discrete(N_a)`: the flat index `(((x_B * D_B + y_B) * W_T + x_T) * D_T + y_T) * R + r` of pick cell, place cell and
    rotation. Most actions fail; `action_masks()` marks those that would succeed.

    ## Observation Space
    A `Dict`:

    | key | shape, type | meaning |
    |---|---|---|
    | `bin_depth` | `(W_B, D_B)` float32 | height above the bin's floor, 0 where empty; height units |
    | `tote_depth` | `(W_T, D_T)` float32 | remaining height up to the rim; height units |
    | `tote_bearing` | `(W_T, D_T)` float32 | 1 where the cell bears weight, else 0; all 1 unless `support=bearing` |
    | `tote_height` | `(1,)` int64 | height of the episode's tote; height units |

    With `bin_items=M` above 1 also

    | key | shape, type | meaning |
    |---|---|---|
    | `bin_labels` | `(W_B, D_B)` float32 | number of the item on each cell of the bin, from 1; 0 where empty |
    | `items` | `(M, 5)` int64 | x, y, w, d, h of each item in the bin; zeros: none |

    with `preview=p` `coming`, `(p, 5)` int64: x, y, w, d, h of the items that arrive next, in their order; zeros: none;
    with `handling=True` the items' `handling`, and the pile in the tote: `tote_labels`, `pile_spare` and `pile_below`;
    with `support=pct` `tote_boxes`, `(L, 6)` int64: x, y, z, w, d, h of the items in the tote;
    and the terms of `observation=` (see `PickPlaceEnv`).

    ## Rewards
    The volume placed, in cells times height units; 0 for an action that fails. An episode's return is the volume
    packed.

    ## Starting State
    An empty tote, and a bin with the first item of an episode. `reset(seed=s)` begins the item stream `s`; later resets
    without a seed play its next episodes. `options={"tote_height": h}` sets the height of this episode's tote. With
    `varies=("rotations", ...)` there is an option for each of these, too: `rotations` (a number, or a list of the
    allowed ones), `bin_items`, `refill`, `preview`, `item_mix` (a number, see `ItemDistribution.mixed`)
    and `level`.

    ## Episode End
    Termination: the action fails, or no action is feasible with any item in the bin. Truncation: the item stream has
    ended. No item follows, so a learner that bootstraps truncated episodes should use a value of 0.

    ## Information
    `occupancy`: share of the tote's volume that is filled; `failure`: why the action or the episode failed (`"none"`,
    `"pick_miss"`, ..., `"stuck"`); `action_mask`: the same as `action_masks()`.

    ## Arguments
    `items`: an item distribution, or a list of `(w, d, h)`; by default the paper's four kinds. The settings of
    `pickplace.CellSpec`; `stream`, `observation` and `device` of `pickplace.PickPlaceEnv`. `render_mode`: `"rgb_array"`
    or `"human"`, with `gymnasium.make`.

    ## Version History
    * v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": []}
    action_space: spaces.Discrete

    def __init__(self, items=None, **settings):
        self._vector = PickPlaceVectorEnv(1, items, AutoresetMode.DISABLED, **settings)
        self._env, self.action_space = self._vector._env, self._vector.single_action_space
        self.observation_space = self._vector.single_observation_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        expect("reset_mask" not in (options or {}), "options", options, "no reset_mask")
        observations, infos = self._vector.reset(seed=seed, options=options)
        super().reset(seed=None if seed is None else int(seed))
        return _first(observations, self._env.terms), _first(infos, INFO)

    def step(self, action):
        expect(self.action_space.contains(action), "action", action, f"a whole number in [0, {self.action_space.n})")
        observations, *results, infos = self._vector.step(np.array([action]))
        return _first(observations, self._env.terms), *(part[0].item() for part in results), _first(infos, INFO)

    def action_masks(self) -> np.ndarray:
        """Return a mask of the actions that would succeed, bool ``[N_a]``; sb3-contrib's MaskablePPO calls it."""
        return self._vector.action_masks()[0]


def _first(arrays: dict[str, np.ndarray], keys: Iterable[str]) -> dict[str, Any]:
    return {key: arrays[key][0] for key in keys}


class PickPlaceVectorEnv(gymnasium.vector.VectorEnv):
    """Many problems at once, as tensors; made by ``gymnasium.make_vec("pickplace/PickPlace-v0", num_envs=N)``.

    Spaces, rewards and information are those of :class:`PickPlaceGymEnv`. ``reset(seed=s)`` begins the item stream
    ``s``: slot ``i`` plays its episodes ``i``, ``i + N``, ``i + 2 N``, ... ``options``: ``tote_height`` (a number, or
    one for each slot), other settings of the episodes (one value, or a list with one for each slot), and ``reset_mask``
    (bool ``[N]``, the slots to reset). A plain list of ``rotations`` is one value, for all slots; values for each slot
    are a list of lists. A slot that resets itself plays the full task.

    Args:
        num_envs: ``N``.
        items: an item distribution, or a list of ``(w, d, h)``.
        autoreset_mode: Gymnasium's ``"NextStep"`` (the default), ``"SameStep"`` or ``"Disabled"``.
        **settings: see :class:`PickPlaceGymEnv`; there is no rendering.
    """

    single_action_space: spaces.Discrete

    def __init__(
        self,
        num_envs: int = 1,
        items=None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **settings,
    ):
        expect(render_mode is None, "render_mode", render_mode, "None; render a single environment")
        modes = {mode.value: mode for mode in AutoresetMode}
        known = autoreset_mode in [*AutoresetMode, *modes]
        expect(known, "autoreset_mode", autoreset_mode, f"one of {', '.join(map(repr, modes))}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        for key, why in (("masks", "the action mask always comes along"), ("seed", "reset(seed=...) begins a stream")):
            expect(key not in settings, key, settings.get(key), f"no such argument; {why}")
        self._env = env = PickPlaceEnv(items=items, num_envs=num_envs, **settings)
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        boxes: dict[str, spaces.Space] = {
            key: spaces.Box(low, high, shape, torch.empty(0, dtype=dtype).numpy().dtype.type)
            for key, (low, high, shape, dtype) in env.bounds.items()
        }
        self.single_observation_space = spaces.Dict(boxes)
        self.single_action_space = spaces.Discrete(env.cell.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)  # slots that wait for their reset
        self._started = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        is_one = not isinstance(seed, (list, tuple, np.ndarray))
        expect(is_one, "seed", seed, "one whole number; its stream gives each slot its own episodes")
        seed = None if seed is None else check_seed(seed)
        super().reset(seed=seed)
        options = dict(options or {})
        known = ("tote_height", *self._env.cell.varies, "reset_mask")
        if unknown := sorted(set(options) - {*known}):
            expected = " or ".join(", ".join(known).rsplit(", ", 1))
            raise ValueError(f"options[{unknown[0]!r}]: there is no such option; expected {expected}.")
        rows = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        settings = {key: self._entry(key, value) for key, value in options.items()}
        good = rows.shape == (self.num_envs,) and rows.dtype == bool and rows.any()
        expect(good, "options['reset_mask']", rows, f"bool of shape ({self.num_envs},), at least one True")
        if seed is not None or not self._started:
            expected = "none in the first reset, or with a seed; a stream begins for all slots"
            expect(rows.all(), "options['reset_mask']", rows, expected)
            self._env.set_seed(int(self.np_random.integers(2**31)) if seed is None else seed)
            self._started = True
        self._reset_rows(rows, settings)
        self._ended = self._ended & ~rows
        state = self._env._observation()
        return self._observations(state), self._infos(state, rows)

    def step(self, actions):
        if not self._started:
            raise gymnasium.error.ResetNeeded("step() before reset().")
        actions = np.asarray(actions)
        good = actions.dtype.kind in "iu" and self.action_space.contains(actions.astype(np.int64, copy=False))
        expect(good, "actions", actions, f"{self.num_envs} whole numbers in [0, {self.single_action_space.n})")
        waiting = self._ended
        if waiting.any() and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(f"slots {np.flatnonzero(waiting).tolist()} have ended: reset them first.")
        chosen = torch.as_tensor(np.where(waiting, 0, actions), dtype=torch.int64)
        state = self._env.step(TensorDict({"action": chosen}, [self.num_envs], device=self._env.device))["next"]
        reward, terminated, truncated = (
            state[key][:, 0].cpu().numpy().copy() for key in ("reward", "terminated", "truncated")
        )
        reward = reward.astype(np.float64)
        infos: dict[str, Any] = {}
        if waiting.any():  # their action did not count: this step is their reset
            self._reset_rows(waiting)
            reward[waiting] = terminated[waiting] = truncated[waiting] = 0
            failure = state["failure"].masked_fill(torch.as_tensor(waiting, device=self._env.device)[:, None], 0)
            state = self._env._observation().set("failure", failure)
        self._ended = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            final = self._observations(state)
            each = [
                {key: value[slot] for key, value in final.items()} if over else None
                for slot, over in enumerate(self._ended)
            ]
            infos["final_obs"] = np.array(each, dtype=object)
            infos["final_info"] = self._infos(state, self._ended)
            infos["_final_obs"] = infos["_final_info"] = self._ended.copy()
            self._reset_rows(self._ended)
            state, self._ended = self._env._observation(), np.zeros(self.num_envs, dtype=bool)
        infos |= self._infos(state, np.ones(self.num_envs, dtype=bool))
        return self._observations(state), reward, terminated, truncated, infos

    def action_masks(self) -> np.ndarray:
        """Return a mask of the actions that would succeed, bool ``[N, N_a]``.

        A slot that resets itself in the next step has only action 0. It is ignored, but a masking learner needs one.
        """
        return self._permitted(self._env.action_mask)

    def _permitted(self, mask: torch.Tensor) -> np.ndarray:
        masks = mask.cpu().numpy().copy()
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            masks[self._ended] = np.arange(masks.shape[1]) == 0
        return masks

    def _entry(self, key: str, given: Any) -> torch.Tensor:
        """Return an option, a value or a list of one for each problem, as an entry of an observation, ``[N, ...]``."""
        setting, place, cell = RESET_ENTRIES[key], f"options[{key!r}]", self._env.cell
        given = given.tolist() if isinstance(given, np.ndarray) else given
        try:
            numbers = [setting.read(place, given, cell)] * self.num_envs
        except ValueError:
            if not isinstance(given, (list, tuple)) or len(given) != self.num_envs:
                raise
            numbers = [setting.read(place, value, cell) for value in given]
        return setting.decode(torch.tensor(numbers), cell)

    def _reset_rows(self, rows: np.ndarray, settings: Mapping[str, torch.Tensor] = MappingProxyType({})) -> None:
        entries = {"_reset": torch.as_tensor(rows.copy())[:, None], **settings}
        self._env.reset(TensorDict(entries, [self.num_envs], device=self._env.device))

    def _observations(self, state) -> dict[str, np.ndarray]:
        return {key: state[key].cpu().numpy().copy() for key in self._env.terms}

    def _infos(self, state, rows: np.ndarray) -> dict[str, Any]:
        """Return infos in Gymnasium's form: an array for each key, and a mask ``_key`` of the slots that have it."""
        names = np.array([failure.name.lower() for failure in Failure], dtype=object)
        infos = {
            "occupancy": state["occupancy"][:, 0].double().cpu().numpy().copy(),
            "failure": names[state["failure"][:, 0].cpu().numpy()],
            "action_mask": self._permitted(state["action_mask"]),
        }
        for value in infos.values():
            value[~rows] = None if value.dtype == object else 0
        return infos | {f"_{key}": rows.copy() for key in infos}
