"""Checks of a training config before anything is built."""

from collections.abc import Callable
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from pickplace.runs.allowlist import own_modules
from pickplace.task.checks import is_number, is_whole
from pickplace.task.items import check_seed


class Expectation(NamedTuple):
    """A condition on a value of the config, and its words."""

    holds: Callable[[Any], bool]
    words: str  # "... expected <words>."


def _between(low: float, high: float | None = None) -> Expectation:
    words = f"a number >= {low}" + ("" if high is None else f" and <= {high}")
    return Expectation(lambda value: is_number(value) and low <= value and (high is None or value <= high), words)


COUNT = Expectation(
    lambda value: is_whole(value) and 1 <= value < 2**63,
    "a whole number >= 1 and < 2**63",
)
NODE = Expectation(
    lambda value: OmegaConf.is_dict(value) and "_target_" in value,
    "the settings of an object, with its _target_",
)
SWITCH = Expectation(lambda value: isinstance(value, bool), "true or false")

#: What each key must be, checked in this order.
EXPECTED = {
    **dict.fromkeys(("total_frames", "evaluation_interval", "checkpoint_interval", "progress_interval"), COUNT),
    **dict.fromkeys(("env.num_envs", "algo.rollout_length", "algo.epochs", "algo.minibatch_size"), COUNT),
    **dict.fromkeys(("evaluation.episodes", "evaluation.batch_size"), COUNT),
    **dict.fromkeys(("items", "env", "model.actor", "model.critic", "curriculum", "collector"), NODE),
    **dict.fromkeys(("planner", "logger"), NODE),
    "algo.loss": Expectation(lambda value: value in ("a2c", "ppo"), "ppo or a2c"),
    **dict.fromkeys(("algo.mask_infeasible", "algo.normalize_advantage"), SWITCH),
    "planner._target_": Expectation(
        lambda value: value == "policy",
        "planner=policy, since training validates its own policy",
    ),
    "evaluation.stream": Expectation(
        lambda value: value == "validation", "validation, on which training selects its best policy"
    ),
    "algo.lr_decay_start": Expectation(
        lambda value: value is None or (is_number(value) and 0 <= value <= 1),
        "a share of total_frames between 0 and 1, or null",
    ),
    **dict.fromkeys(("algo.gamma", "algo.lmbda", "algo.clip_epsilon"), _between(0, 1)),
    **dict.fromkeys(("algo.lr", "algo.entropy_coeff", "algo.critic_coeff"), _between(0)),
    **dict.fromkeys(("algo.max_grad_norm", "algo.reward_scale"), _between(0)),
}


def check_settings(cfg: DictConfig) -> None:
    """Check the config of a training before anything is built.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    for key, expected in EXPECTED.items():
        value = OmegaConf.select(cfg, key)
        if not expected.holds(value):
            raise ValueError(f"{key}={value}: expected {expected.words}.")
    check_seed(cfg.seed)
    check_seed(cfg.evaluation.seed, "evaluation.seed")
    own_modules(cfg.trust)
    if cfg.algo.loss == "a2c" and cfg.algo.normalize_advantage and cfg.env.num_envs * cfg.algo.rollout_length == 1:
        raise ValueError(
            "algo.normalize_advantage=True: a batch of one frame (env.num_envs x algo.rollout_length) has no variance; "
            "expected more frames, or false."
        )
