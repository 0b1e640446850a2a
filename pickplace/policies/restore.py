"""Policies and critics from checkpoints."""

import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from pickplace.common.machine import usable_device
from pickplace.common.validate import expect, refuse_if
from pickplace.config.allowlist import trusted_config
from pickplace.config.registry import build, node_of
from pickplace.envs.masks import MASKS
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.items.tipping import longest_side
from pickplace.policies.base import EstimatesValue, Policy, as_collection_policy, as_critic
from pickplace.rules.cell import CELL_SETTINGS, CellSpec, cell_from_settings
from pickplace.rules.item import Observation
from pickplace.rules.masks import placing_maps
from pickplace.rules.observation import Term, check_terms
from pickplace.rules.state import State
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate

SIZES = ("gripper", "bin_size", "tote_size")


def restore_policy(cfg: DictConfig, cell: CellSpec, state: dict, trained_env: dict) -> Policy:
    """Return the policy of a checkpoint for a cell, whose sizes may differ from those in training.

    Args:
        cfg: the checkpoint's config, with any overrides on top.
        cell: the sizes.
        state: the policy's tensors, ``state["policy"]`` of :func:`pickplace.runs.checkpoint.read`.
        trained_env: the group ``env`` in training; the cell may not have more ``rotations``.

    Raises:
        ValueError: for more rotations than were trained, or tensors that do not fit the config or the sizes.
    """
    refuse_if(
        cell.rotations > trained_env["rotations"],
        f"env.rotations={cell.rotations}: the checkpoint was trained with {trained_env['rotations']}; expected no "
        "more.",
    )

    def restored(cell: CellSpec) -> Policy:
        make = partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=cfg.model.mask_infeasible)
        return checkpoint.restore(make, state, "policy").eval()

    try:
        return restored(cell)
    except checkpoint.CheckpointError as error:
        trained = build_cell(trained_env, reach=None)  # the file of a reach table may be missing here
        ours, theirs = (cell_settings(one, SIZES) for one in (cell, trained))
        different = [*differences(ours, theirs, "env")]
        if not different:
            raise
        sizes: dict[str, Any] = {key: getattr(trained, key) for key in SIZES}
        restored(replace(cell, reach=None, **sizes))  # if that fails too, the sizes are not the reason
        new = ", ".join(f"{key}={json.dumps(value)}" for key, value, _ in different)
        old = ", ".join(json.dumps(value) for _, _, value in different)
        raise checkpoint.CheckpointError(
            f"{new}: the checkpoint was trained with {old}, and its policy does not serve every other cell."
        ) from error


class TrainedPolicy(TensorDictModuleBase):
    """The policy of a checkpoint as a module: an observation of :class:`PickPlaceEnv` in, ``action`` int64 ``[N]`` out.

    It plays the most probable feasible action. Under ``set_exploration_type(ExplorationType.RANDOM)``, which TorchRL's
    collectors set, it draws as in training: among feasible actions if it was trained with a mask, else among all.

    Args:
        policy: the distribution over choices, made for a cell.
        terms: of the observation, by key.
        config: of the training.

    Attributes:
        cell: the sizes for which it decides.
    """

    def __init__(self, policy: Policy, terms: Mapping[str, Term], config: DictConfig):
        super().__init__()
        self.policy, self.cell, self.terms, self.config = policy, policy.cell, terms, config
        self.in_keys, self.out_keys = [key for key in policy.act_keys if not key.endswith("_mask")], ["action"]
        self._draw = as_collection_policy(policy)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select(*self.in_keys).reshape(-1)
        maps = placing_maps(self.cell, State.from_observation(seen))
        if exploration_type() == ExplorationType.RANDOM:
            seen.update({f"{name}_mask": MASKS[name].make(self.cell, maps) for name in self.policy.masks})
            action = self._draw(seen)["action"]
        else:
            action = self.policy.best_feasible(seen, maps)
        return tensordict.set("action", action.reshape(tensordict.batch_size))

    def make_env(self, num_envs: int = 1, **options) -> PickPlaceEnv:
        """Return an environment with the policy's cell, and with items and observation of its training.

        Args:
            num_envs: ``N``.
            **options: further arguments of :class:`PickPlaceEnv`, such as ``items`` or ``stream="test"``; but no
                ``varies``.
        """
        expect(
            "varies" not in options,
            "varies",
            options.get("varies"),
            "no such argument; a loaded policy plays the full task",
        )
        items = options.pop("items", None) or build("items", self.config["items"])
        cell = {item.name: getattr(self.cell, item.name) for item in fields(CellSpec)}
        device = next(self.parameters()).device
        return PickPlaceEnv(num_envs=num_envs, items=items, observation=self.terms, device=device, **cell, **options)


def build_cell(env: dict, **given) -> CellSpec:
    """Return the cell of a config's group ``env``.

    Args:
        env: the settings, resolved; those that a cell does not have are ignored.
        **given: settings of the cell that replace them, as objects.

    Raises:
        ValueError: see :func:`~pickplace.config.registry.build` and :class:`~pickplace.rules.cell.CellSpec`.
    """
    own = {key: env[key] for key in CELL_SETTINGS if key in env and key not in given}
    return cell_from_settings({**build("env", own), **given})


def cell_settings(cell: CellSpec, keys: Collection[str] = CELL_SETTINGS) -> dict[str, Any]:
    """Return settings of a cell in the form of a config's group ``env``."""
    return {key: node_of(f"env.{key}", getattr(cell, key)) for key in keys}


def differences(ours: Any, theirs: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the keys in which two parts of configs differ, with both values; if the classes differ, their names."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        names = ours.get("_target_"), theirs.get("_target_")
        if names[0] != names[1]:
            yield place, *names
            return
        for key in {**ours, **theirs}:
            yield from differences(ours.get(key), theirs.get(key), f"{place}.{key}".lstrip("."))
    elif ours != theirs:
        yield place, ours, theirs


def changed_settings(ours: dict, theirs: dict, with_critic: bool) -> Iterator[tuple[str, Any, Any]]:
    """Yield the settings that have changed since the weights were trained, as :func:`differences`.

    Args:
        ours: the whole config of a training that begins with these weights.
        theirs: that of their own training. What an older one lacks in its group ``env`` had the default.
        with_critic: whether the weights have a critic, which expects discounted, scaled rewards.
    """
    yield from differences(ours["env"], cell_settings(CellSpec()) | theirs["env"], "env")
    yield from differences(ours["items"], theirs["items"], "items")
    if with_critic:
        yield from differences(ours["reward_scale"], theirs["reward_scale"], "reward_scale")
        yield from differences(ours["algo"].get("gamma"), theirs["algo"].get("gamma"), "algo.gamma")


def load_policy(path, device: str = "cpu", trust: Sequence[str] = (), **sizes) -> TrainedPolicy:
    """Return the policy of a checkpoint as a module; its ``make_env()`` makes an environment for it.

    Args:
        path: a run folder, a checkpoint, or ``pretrained/<name>``.
        device: where to compute, ``"cpu"`` or ``"cuda"``.
        trust: your own modules whose classes the checkpoint's config may name.
        **sizes: settings that differ from the training's, such as ``tote_size=(30, 30, 10)``; see
            :class:`~pickplace.rules.cell.CellSpec`. A fully convolutional policy serves any bin and tote, and any
            end effector if it was trained with a mask.

    Raises:
        ValueError: for a checkpoint that cannot be used, or bad sizes.
    """
    expect(isinstance(path, (str, os.PathLike)), "path", path, "a run folder, a checkpoint, or pretrained/<name>")
    state, facts = checkpoint.read(locate(path))
    cfg = trusted_config(facts["config"], trust)
    env = cast(dict, OmegaConf.to_container(cfg.env, resolve=True))
    cell = build_cell(env, **sizes)
    if not (cell.has_known_offsets or cfg.model.mask_infeasible):  # it gives the number of grasps to choose among
        cell = replace(cell, longest_side=longest_side(cell, build("items", cfg["items"])))
    policy = restore_policy(cfg, cell, state["policy"], env).to(usable_device(device))
    given = env.get("observation") or {}
    expect(isinstance(given, dict), "env.observation", given, "terms by their keys")
    terms = {str(key): build(f"env.observation.{key}", node) for key, node in given.items()}
    return TrainedPolicy(policy, check_terms(terms, policy.cell), cfg)


def load_critic(path, trained: TrainedPolicy) -> "RestoredCritic | None":
    """Return the critic from the checkpoint of a loaded policy, see :func:`load_policy`; None if it does not serve."""
    env = cast(dict, OmegaConf.to_container(trained.config.env, resolve=True))
    return restore_critic(trained.config, trained.policy, checkpoint.read(locate(path))[0], env)


@dataclass(frozen=True)
class RestoredCritic:
    """A function from observations to values ``[N, 1]``, in cells times height units."""

    network: torch.nn.Module
    in_keys: list[str]
    reward_scale: float

    def with_bin_items(self, bin_items: int) -> "RestoredCritic":
        """Return this critic for bins with another number of items."""
        keys_for = getattr(self.network, "keys_for", None)  # others see depth maps only
        return self if keys_for is None else replace(self, in_keys=[*keys_for(bin_items)])

    def __call__(self, observation: Observation) -> Tensor:
        return self.network(*(observation[key] for key in self.in_keys)) / self.reward_scale


def restore_critic(cfg: DictConfig, policy: Policy, state: dict, trained_env: dict) -> RestoredCritic | None:
    """Return the critic of a checkpoint.

    Args:
        cfg: the checkpoint's config.
        policy: the policy of the checkpoint, which has the sizes.
        state: as :func:`pickplace.runs.checkpoint.read` returns it, with or without ``state["critic"]``.
        trained_env: the group ``env`` in training.

    Returns:
        The critic; None if there is none, or it does not serve this tote.
    """
    if isinstance(policy, EstimatesValue):
        critic = as_critic(policy.value_network())
        return RestoredCritic(critic.module, list(critic.in_keys), cfg.reward_scale)
    if "critic" not in state or cfg.model.critic is None:
        return None

    def make():
        return as_critic(build("model.critic", cfg.model.critic, cell=policy.cell))

    with torch.device("meta"):
        any_size = getattr(make().module, "any_size", False)
    if tuple(trained_env["tote_size"][:2]) != policy.cell.tote_size[:2] and not any_size:
        return None
    critic = checkpoint.restore(make, state["critic"], "critic").to(cfg.device).eval()
    return RestoredCritic(critic.module, list(critic.in_keys), cfg.reward_scale)
