"""Checks of a training config before anything is built."""

from functools import partial

from omegaconf import DictConfig, OmegaConf

from pickplace.algorithms.base import Algorithm
from pickplace.common.validate import check_bytes, excerpt, flag, number, whole_number
from pickplace.config.allowlist import own_modules
from pickplace.envs.checks import problem_bytes
from pickplace.envs.torchrl import MASKS, PickPlaceEnv
from pickplace.evaluation.play import check_episode_settings, check_play
from pickplace.items.distributions import check_seed
from pickplace.policies.base import Policy


def _node(key: str, value) -> None:
    if not OmegaConf.is_dict(value) or "_target_" not in value:
        raise ValueError(f"{key}={excerpt(value)}: expected the settings of an object, with its _target_.")


def _group(key: str, value) -> None:
    if not OmegaConf.is_dict(value):
        raise ValueError(f"{key}={excerpt(value)}: expected settings by their names.")


def _text(key: str, value) -> None:
    if not isinstance(value, str) or len(value) > 1_000:
        raise ValueError(f"{key}={excerpt(value)}: expected a text of at most 1,000 characters.")


def _or_null(check):
    return lambda key, value: None if value is None else check(key, value)


def _only(expected: str, reason: str):
    def check(key: str, value) -> None:
        if value != expected:
            raise ValueError(f"{key}={excerpt(value)}: expected {expected}, {reason}.")

    return check


#: The check of each key, in this order.
CHECKS = {
    **dict.fromkeys(("env", "items", "algo", "curriculum", "collector", "planner", "logger"), _node),
    **dict.fromkeys(("model", "evaluation", "warm_start"), _group),
    "model.actor": _node,
    **dict.fromkeys(("model.critic", "warm_start.teacher"), _or_null(_node)),
    "callbacks": _or_null(_group),
    **dict.fromkeys(("warm_start.checkpoint", "warm_start.weights"), _or_null(_text)),
    **dict.fromkeys(("warm_start.frames", "warm_start.critic_frames"), partial(whole_number, least=0)),
    **dict.fromkeys(("total_frames", "evaluation_interval", "checkpoint_interval", "progress_interval"), whole_number),
    "env.num_envs": partial(whole_number, most=32_768),
    "rollout_length": whole_number,
    "model.mask_infeasible": flag,
    "planner._target_": _only("policy", "since training validates its own policy"),
    "evaluation.stream": _only("validation", "on which training selects its best policy"),
    "reward_scale": partial(number, least=1e-9, most=1e38),  # float32 ends there
    "seed": lambda key, value: check_seed(value, key),
}


def check_settings(cfg: DictConfig) -> None:
    """Check the config of a training before anything is built.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    for key, check in CHECKS.items():
        check(key, OmegaConf.select(cfg, key))
    check_episode_settings(cfg.evaluation)
    own_modules(cfg.trust)


def check_memory(cfg: DictConfig, env: PickPlaceEnv, policy: Policy, algorithm: Algorithm) -> None:
    """Refuse batches that would fill the memory.

    A frame holds two observations, masks once, and what the critic computes for it, measured with ``pooled``.

    Args:
        cfg: the config.
        env: its environment, with any number of problems and without masks.
        policy: the policy that is trained.
        algorithm: the algorithm.

    Raises:
        ValueError: naming the keys, their values, and the memory.
    """
    cell, masks, slots, steps = env.cell, policy.masks, cfg.env.num_envs, cfg.rollout_length
    frame = 2 * env.observation_bytes + sum(MASKS[name].size(cell) for name in masks) + 200 * cell.num_places
    frame += 20  # choice, log-probability, action
    check_bytes(f"env.num_envs={slots}, rollout_length={steps}", slots * steps * frame, env.device)
    for setting, needed in algorithm.memory(frame).items():
        check_bytes(setting, needed, env.device)
    problem = max(problem_bytes(cell, masks), policy.acting_bytes)
    check_bytes(f"env.num_envs={slots}", slots * problem, env.device)
    check_play(cfg.evaluation, cell, env.device)
