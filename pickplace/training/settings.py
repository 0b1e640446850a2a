"""Checks of a training config before anything is built."""

from functools import partial

from omegaconf import DictConfig, OmegaConf

from pickplace.common.validate import check_bytes, excerpt, flag, number, one_of, whole_number
from pickplace.config.allowlist import own_modules
from pickplace.envs.checks import problem_bytes
from pickplace.envs.torchrl import MASKS, PickPlaceEnv
from pickplace.evaluation.play import check_episode_settings, check_play
from pickplace.items.distributions import check_seed
from pickplace.policies.base import EstimatesValue, Policy


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


_share = partial(number, most=1)
_weight = partial(number, most=1e38)  # float32 ends there
_positive = partial(number, least=1e-9, most=1e38)

#: The check of each key, in this order.
CHECKS = {
    **dict.fromkeys(("env", "items", "curriculum", "collector", "planner", "logger"), _node),
    **dict.fromkeys(("model", "algo", "evaluation", "warm_start"), _group),
    **dict.fromkeys(("model.actor", "model.critic"), _node),
    "callbacks": _or_null(_group),
    "warm_start.teacher": _or_null(_node),
    **dict.fromkeys(("warm_start.checkpoint", "warm_start.weights"), _or_null(_text)),
    **dict.fromkeys(("warm_start.frames", "warm_start.critic_frames"), partial(whole_number, least=0)),
    **dict.fromkeys(("total_frames", "evaluation_interval", "checkpoint_interval", "progress_interval"), whole_number),
    "env.num_envs": partial(whole_number, most=32_768),
    **dict.fromkeys(("rollout_length", "algo.minibatch_size"), whole_number),
    "algo.epochs": partial(whole_number, most=1_000),
    "algo.vine_samples": _or_null(partial(whole_number, most=10_000)),
    "algo.vine_temperature": partial(number, least=0.01, most=100.0),
    "algo.advantages": partial(one_of, choices=("vine", "gae")),
    "algo.loss": partial(one_of, choices=("ppo", "a2c", "td")),
    **dict.fromkeys(("model.mask_infeasible", "algo.normalize_advantage"), flag),
    "planner._target_": _only("policy", "since training validates its own policy"),
    "evaluation.stream": _only("validation", "on which training selects its best policy"),
    "algo.lr_decay_start": _or_null(_share),
    **dict.fromkeys(("algo.gamma", "algo.lmbda", "algo.clip_epsilon"), _share),
    **dict.fromkeys(("algo.lr", "algo.entropy_coeff", "algo.critic_coeff"), _weight),
    **dict.fromkeys(("algo.max_grad_norm", "reward_scale"), _positive),
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
    several = cfg.env.get("bin_items", 1)
    if several != 1 and cfg.algo.vine_samples is not None and cfg.algo.advantages == "vine":
        raise ValueError(
            f"algo.advantages=vine: expected gae with env.bin_items={excerpt(several)}; vine knows one item in the bin."
        )
    own_modules(cfg.trust)
    if cfg.algo.loss == "a2c" and cfg.algo.normalize_advantage and cfg.env.num_envs * cfg.rollout_length == 1:
        raise ValueError(
            "algo.normalize_advantage=True: a batch of one frame (env.num_envs x rollout_length) has no variance; "
            "expected more frames, or false."
        )


def check_learner(cfg: DictConfig, policy: Policy) -> None:
    """Check that the policy learns by the loss, and that nothing is asked for which that has no use.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    algo, warm_start = cfg.algo, cfg.warm_start
    estimates_value = isinstance(policy, EstimatesValue)
    if estimates_value != (algo.loss == "td"):
        expected = "'td' with model=afterstate" if estimates_value else "'ppo' or 'a2c'; 'td' is for model=afterstate"
        raise ValueError(f"algo.loss={excerpt(algo.loss)}: expected {expected}.")
    if algo.loss != "td":
        return
    for key in ("frames", "critic_frames"):
        if warm_start[key]:
            raise ValueError(f"warm_start.{key}={excerpt(warm_start[key])}: expected 0 with algo.loss=td.")
    if cfg.rollout_length < 2:
        raise ValueError(f"rollout_length={excerpt(cfg.rollout_length)}: expected at least 2 with algo.loss=td.")
    if algo.vine_samples is not None:
        raise ValueError(f"algo.vine_samples={excerpt(algo.vine_samples)}: expected null with algo.loss=td.")
    scale = cfg.model.actor.get("reward_scale", 1.0)
    if scale != cfg.reward_scale:
        raise ValueError(f"model.actor.reward_scale={excerpt(scale)}: expected reward_scale={cfg.reward_scale}.")
    if dict(cfg.model.critic) != {"_target_": "tote_value"}:
        raise ValueError(
            f"model.critic={excerpt(dict(cfg.model.critic))}: expected {{'_target_': 'tote_value'}} with algo.loss=td, "
            "as the actor's network is the critic."
        )


def check_memory(cfg: DictConfig, env: PickPlaceEnv, policy: Policy) -> None:
    """Refuse batches that would fill the memory.

    A frame holds two observations, masks once, and what the critic computes for it, measured with ``pooled``.

    Args:
        cfg: the config.
        env: its environment, with any number of problems and without masks.
        policy: the policy that is trained.

    Raises:
        ValueError: naming the keys, their values, and the memory.
    """
    cell, masks, slots, steps = env.cell, policy.masks, cfg.env.num_envs, cfg.rollout_length
    samples = cfg.algo.vine_samples
    frame = 2 * env.observation_bytes + sum(MASKS[name].size(cell) for name in masks) + 200 * cell.num_places
    frame += 20 * (1 + (samples or 0))
    check_bytes(f"env.num_envs={slots}, rollout_length={steps}", slots * steps * frame, env.device)
    part = min(cfg.algo.minibatch_size, slots * steps)
    learning = policy.learning_bytes(None if cfg.warm_start.frames else samples)  # imitation needs all logits
    check_bytes(f"algo.minibatch_size={part}", part * learning, env.device)
    problem = max(problem_bytes(cell, masks), policy.acting_bytes)
    check_bytes(f"env.num_envs={slots}", slots * problem, env.device)
    check_play(cfg.evaluation, cell, env.device)
