"""An evaluation: one code path for every planner, on fixed item streams."""

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, open_dict

from pickplace.common.machine import use_machine
from pickplace.common.validate import refuse_if
from pickplace.config.allowlist import own_modules, trusted_config
from pickplace.config.composition import use_whole_numbers
from pickplace.config.registry import build
from pickplace.evaluation.artifacts import Artifacts, evaluation_table
from pickplace.evaluation.command import TRAINED, merge_trained
from pickplace.evaluation.play import MakeEnv, carry_out, check_episode_settings, check_play, decision_latency, play
from pickplace.evaluation.result import (
    describe,
    episode_settings,
    paired_difference,
    read_comparison,
    resolved,
    summarise_physics,
)
from pickplace.physics.engine import build_engine
from pickplace.physics.recorded import plan_of
from pickplace.planners.base import BatchPlanner
from pickplace.planners.use import planner_parts
from pickplace.runs import checkpoint, folder
from pickplace.runs.locate import locate
from pickplace.runs.provenance import first_steps

log = logging.getLogger(__name__)


def run(cfg: DictConfig, run_dir: Path) -> float:
    """Evaluate as the config says (``conf/evaluate.yaml``), and return the mean occupancy.

    Writes ``evaluation.json``, a table, a picture of a packed tote and a replay into ``run_dir``.

    Raises:
        ValueError: for settings that make no sense, a checkpoint that does not fit them, or a folder that holds a
            training or another evaluation.
    """
    with folder.claim(run_dir):
        folder.refuse_occupied(run_dir)
        ev, artifacts = cfg.evaluation, Artifacts(cfg.evaluation)
        engine = build_engine(cfg.physics) if cfg.physics else None
        make_env, planner, facts = prepare(cfg)
        cell, settings = make_env(0, 1).cell, episode_settings(cfg)
        refuse_if(
            cell.tipping and getattr(engine, "grips", False),
            "env.tipping=true: physics=execute carries items with a gripper, which tips none; expected physics=settle.",
        )
        other = (
            None if cfg.compare is None else read_comparison(Path(str(cfg.compare)), settings, own_modules(cfg.trust))
        )

        log.info("%s episodes to play with %s", f"{ev.episodes:,}", planner.name)
        recorded = ev.episodes if artifacts.plans or engine else max(artifacts.replay, 1)
        episodes = play(make_env, planner, ev.episodes, ev.batch_size, range(recorded), range(artifacts.replay))
        result = describe(planner, facts | settings, episodes)
        result["latency_ms"] = decision_latency(make_env, planner, ev.latency_decisions)
        plans = [plan_of(each, cell) for each in episodes.recordings]
        if engine:
            outcomes = carry_out(engine, plans, episodes.recordings[: artifacts.replay])
            result["physics"] = summarise_physics(engine, resolved(cfg.physics), outcomes)
        if other:
            result["paired_difference"] = paired_difference(result, other)
        log.info("\n%s", evaluation_table(result))  # before anything is written: the disk may be full

        title = f"{cfg.checkpoint or planner.name}, {ev.stream} stream, seed {ev.seed}"
        artifacts.write(run_dir, result, cell, episodes.recordings, plans, title)
        log.info("run folder: %s", run_dir)
        return result["occupancy"]["mean"]


def prepare(cfg: DictConfig) -> tuple[MakeEnv, BatchPlanner, dict[str, Any]]:
    """Return a function that makes the environment of a config (``conf/evaluate.yaml``), the planner, and facts.

    The groups that a checkpoint brings are put into ``cfg``.

    Raises:
        ValueError: for settings that make no sense, or a checkpoint that does not fit them.
    """
    use_whole_numbers(cfg)
    ev = cfg.evaluation
    check_episode_settings(ev)
    own_modules(cfg.trust)
    use_machine(cfg)
    settings = {key: value for key, value in resolved(cfg.planner).items() if key != "_target_"}
    trained, about = load_trained(cfg) if cfg.checkpoint is not None else (None, {"checkpoint": None})
    facts: dict[str, Any] = {"planner_settings": settings, **about}
    items = build("items", cfg["items"])
    if not items.varies:
        facts["same_items"] = True
        if ev.episodes > 1:
            log.warning("All episodes have the same items: the interval says nothing about other items.")

    def make_env(first, count):
        return build(
            "env", {**resolved(cfg.env), "num_envs": count}, items=items, device=cfg.device, masks=(),
            stream=ev.stream, seed=ev.seed, first_episode=first,
        )  # fmt: skip

    probe = make_env(0, 1)
    check_play(ev, probe)
    planner = build("planner", cfg.planner, **planner_parts(cfg.planner, probe.cell, items, probe.terms, trained))
    refuse_if(  # now, not after all episodes
        not isinstance(planner, BatchPlanner) or not isinstance(planner.name, str),
        f"planner: {type(planner).__name__} has no name; expected an attribute name, a string.",
    )
    if hasattr(planner, "evaluation_facts"):
        facts |= planner.evaluation_facts()
    return make_env, planner, facts


def load_trained(cfg: DictConfig) -> tuple[tuple[DictConfig, dict, dict], dict[str, Any]]:
    """Return a checkpoint as the argument ``trained`` of :func:`planner_parts`, and facts about its training.

    The checkpoint's groups :data:`TRAINED` are put into ``cfg``, with the command line's overrides on top.

    Raises:
        ValueError: for a checkpoint that cannot be read, or overrides that do not fit it.
    """
    place = locate(str(cfg.checkpoint))
    state, saved = checkpoint.read(place)
    trained = trusted_config(saved["config"], cfg.trust)
    merged = merge_trained(cfg, trained)
    with open_dict(cfg):
        for group in TRAINED:  # resolved where they come from: here a reference could lead elsewhere
            cfg[group] = resolved(merged[group])
        cfg.reward_scale = merged.reward_scale  # the scale of the critic's values
    facts = {
        "checkpoint": str(place),
        "trained": {"frames": saved["frames"], "seed": merged.seed, "commit": saved["commit"]},
        "mask_in_training": merged.model.mask_infeasible,
        **first_steps(saved["config"]),
    }
    return (cfg, state, resolved(trained.env)), facts
