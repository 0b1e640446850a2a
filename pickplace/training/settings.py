"""Checks of a training config before anything is built."""

from functools import partial

from omegaconf import DictConfig, OmegaConf

from pickplace.algorithms.base import Algorithm
from pickplace.common.validate import check_bytes, expect, flag, number, or_null, whole_number
from pickplace.config.allowlist import own_modules
from pickplace.config.composition import use_whole_numbers
from pickplace.envs.checks import problem_bytes
from pickplace.envs.masks import MASKS
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.evaluation.play import check_episode_settings, check_play
from pickplace.items.distributions import check_seed
from pickplace.policies.base import Policy


def _check(is_right, expected: str):
    return lambda key, value: expect(is_right(value), key, value, expected)


_group = _check(OmegaConf.is_dict, "settings by their names")
_node = _check(
    lambda value: OmegaConf.is_dict(value) and "_target_" in value, "the settings of an object, with its _target_"
)
_text = _check(lambda value: isinstance(value, str) and len(value) <= 1_000, "a text of at most 1,000 characters")

#: The check of each key, in this order.
CHECKS: dict = {
    **dict.fromkeys(("env", "items", "algo", "curriculum", "collector", "planner", "logger"), _node),
    **dict.fromkeys(("model", "evaluation", "warm_start"), _group),
    "model.actor": _node,
    **dict.fromkeys(("model.critic", "warm_start.teacher"), partial(or_null, _node)),
    "callbacks": partial(or_null, _group),
    "compile": partial(or_null, _node),
    **dict.fromkeys(("warm_start.checkpoint", "warm_start.weights"), partial(or_null, _text)),
    **dict.fromkeys(("warm_start.frames", "warm_start.critic_frames"), partial(whole_number, least=0)),
    **dict.fromkeys(("total_frames", "checkpoint_interval", "progress_interval"), whole_number),
    "evaluation_interval": partial(or_null, whole_number),
    "env.num_envs": partial(whole_number, most=32_768),
    "rollout_length": whole_number,
    "model.mask_infeasible": flag,
    "planner._target_": _check(lambda value: value == "policy", "policy, since training validates its own policy"),
    "evaluation.stream": _check(
        lambda value: value == "validation", "validation, on which training selects its best policy"
    ),
    "reward_scale": partial(number, least=1e-9, most=1e38),  # float32 ends there
    "quiet": partial(or_null, flag),
    "seed": lambda key, value: check_seed(value, key),
}


def check_settings(cfg: DictConfig) -> None:
    """Check the config of a training before anything is built; 1e5 becomes a whole number in it.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    use_whole_numbers(cfg)
    for key, check in CHECKS.items():
        check(key, OmegaConf.select(cfg, key))
    check_episode_settings(cfg.evaluation)
    own_modules(cfg.trust)


def check_memory(cfg: DictConfig, env: PickPlaceEnv, policy: Policy, algorithm: Algorithm) -> None:
    """Refuse batches that would fill the memory.

    A frame holds two observations, its masks once, and results of the critic, measured with ``pooled``.

    Args:
        cfg: the config.
        env: its environment, with any number of problems and without masks.
        policy: the policy that is trained.
        algorithm: the algorithm.

    Raises:
        ValueError: naming the keys, their values, and the memory.
    """
    cell, masks, slots, steps = env.cell, policy.masks, cfg.env.num_envs, cfg.rollout_length
    emitted = sum(spec.shape[1:].numel() * spec.dtype.itemsize for spec in env.observation_spec.values())
    # The last 20 bytes are choice, log-probability and action.
    frame = 2 * emitted + sum(MASKS[name].size(cell) for name in masks) + 200 * cell.num_places + 20
    check_bytes(f"env.num_envs={slots}, rollout_length={steps}", slots * steps * frame, env.device)
    for setting, needed in algorithm.memory(frame).items():
        check_bytes(setting, needed, env.device)
    check_bytes(f"env.num_envs={slots}", slots * max(problem_bytes(cell, masks), policy.acting_bytes), env.device)
    check_play(cfg.evaluation, env)
