"""The ``pickplace-evaluate`` command: one code path for every planner, on fixed item streams."""

import logging
from pathlib import Path

from omegaconf import DictConfig

from pickplace.config.allowlist import own_modules
from pickplace.config.hydra_app import Command
from pickplace.evaluation.artifacts import Artifacts, evaluation_table
from pickplace.evaluation.parts import prepare
from pickplace.evaluation.play import carry_out, decision_latency, play
from pickplace.evaluation.result import (
    describe,
    episode_settings,
    paired_difference,
    read_comparison,
    resolved,
    summarise_physics,
)
from pickplace.physics.engine import build_engine
from pickplace.physics.plans import CELL_SIZE
from pickplace.physics.recorded import plan_of
from pickplace.runs import folder as run_folders
from pickplace.runs.folder import claim, refuse_occupied

log = logging.getLogger(__name__)


def main() -> None:
    """Entry point of ``pickplace-evaluate``."""
    Command("evaluate", run, run_folders, from_checkpoint=("env", "items", "model"))()


def run(cfg: DictConfig, run_dir: Path) -> float:
    """Evaluate as the config says (``conf/evaluate.yaml``), and return the mean occupancy.

    Writes ``evaluation.json``, a table, a picture of a packed tote and a replay into ``run_dir``.

    Raises:
        ValueError: for settings that make no sense, a checkpoint that does not fit them, or a folder that holds a
            training or another evaluation.
    """
    with claim(run_dir):
        refuse_occupied(run_dir)
        return _evaluate(cfg, run_dir)


def _evaluate(cfg: DictConfig, run_dir: Path) -> float:
    ev, artifacts = cfg.evaluation, Artifacts.asked(cfg.evaluation)
    engine = build_engine(cfg.physics) if cfg.physics else None
    make_env, planner, facts = prepare(cfg)
    cell, settings = make_env(0, 1).cell, episode_settings(cfg)
    other = None if cfg.compare is None else read_comparison(Path(str(cfg.compare)), settings, own_modules(cfg.trust))

    log.info("%s episodes to play with %s", f"{ev.episodes:,}", planner.name)
    recorded = ev.episodes if artifacts.plans or engine else max(artifacts.replay, 1)
    episodes = play(make_env, planner, ev.episodes, ev.batch_size, range(recorded), range(artifacts.replay))
    result = describe(planner, facts | settings, episodes)
    result["latency_ms"] = decision_latency(make_env, planner, ev.latency_decisions)
    size = engine.cell_size if engine else CELL_SIZE
    plans = [plan_of(recording, cell, size) for recording in episodes.recordings]
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
