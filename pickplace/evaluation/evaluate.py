"""The ``pickplace-evaluate`` command: one code path for every planner, on fixed item streams."""

import hashlib
import json
import logging
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from pickplace.common.files import read_file, replaced_file
from pickplace.common.machine import use_machine
from pickplace.common.validate import excerpt, flag, is_name, is_number, whole_number
from pickplace.config.allowlist import own_modules, trusted_config
from pickplace.config.composition import PARTS_OF_ENV, keys_set_in_env, task_overrides
from pickplace.config.errors import sentence
from pickplace.config.registry import build
from pickplace.evaluation.play import Episodes, MakeEnv, check_episode_settings, check_play, decision_latency, play
from pickplace.evaluation.statistics import paired_difference, summarise, summarise_physics
from pickplace.physics.plans import CELL_SIZE, PLANS, to_lines
from pickplace.physics.recorded import motion_for_replay, plan_of
from pickplace.planners.base import BatchPlanner, planner_parts
from pickplace.rules.cell import CELL_SETTINGS, HULL_RULES, CellSpec
from pickplace.runs import checkpoint
from pickplace.runs.folder import EVALUATION, claim, refuse_occupied
from pickplace.runs.hydra_app import apply_overrides, command
from pickplace.runs.provenance import commit, first_weights, imitated_planner, versions
from pickplace.views.replay import animation, page, picture
from pickplace.views.tables import evaluation_table

log = logging.getLogger(__name__)

MAX_EVALUATION = 2**26  # greatest size of an evaluation.json that is read, in bytes

#: Settings of the cell that older files lack; they were played with the default.
YOUNG_SETTINGS = ("body", "cup", "cup_size", "min_seal", "reach", "bin_items", "refill")

#: Config groups that an evaluation takes from the checkpoint; :data:`PARTS_OF_ENV` are in the first.
TRAINED = ("env", "items", "model", "algo")


def main() -> None:
    """Entry point of ``pickplace-evaluate``."""
    command("evaluate", run, from_checkpoint=("model", "items", *(f"env.{part}" for part in PARTS_OF_ENV)))


def run(cfg: DictConfig, run_dir: Path) -> float:
    """Evaluate as the config says (``conf/evaluate.yaml``), and return the mean occupancy.

    Writes ``evaluation.json``, a table, a picture of a packed tote and a replay into ``run_dir``.

    Raises:
        ValueError: for settings that make no sense, a checkpoint that does not fit them, or a folder that holds a
            training or another evaluation.
    """
    with claim(run_dir):
        refuse_occupied(run_dir)
        return _run(cfg, run_dir)


def _run(cfg: DictConfig, run_dir: Path) -> float:
    ev = cfg.evaluation
    replay = whole_number("evaluation.replay", ev.get("replay", 0), 0, 1_000)  # evaluation=validation has neither
    gif = flag("evaluation.gif", ev.get("gif", False))
    plans = flag("evaluation.plans", ev.get("plans", False))
    physics = build("physics", cfg.physics) if cfg.physics else None
    make_env, planner, facts = prepare(cfg)
    cell = make_env(0, 1).cell
    other = None if cfg.compare is None else read_comparison(Path(str(cfg.compare)), episode_settings(cfg))
    result, episodes = evaluate(
        cfg, make_env, planner, facts, ev.episodes if plans or physics else max(replay, 1), heat_maps=replay
    )
    recordings = episodes.recordings
    size = physics.cell_size if physics else CELL_SIZE
    planned = [plan_of(recording, cell, size) for recording in recordings] if plans or physics else []
    if physics:
        outcomes = []
        for outcome in physics.carry_out(planned, record=range(replay)):
            outcomes.append(outcome)
            if outcome.motion:
                recordings[outcome.episode].carried_out = motion_for_replay(outcome, size)
            if len(outcomes) % 10 == 0 or len(outcomes) == len(planned):
                log.info("physics=%s: %s of %s episodes", physics.name, f"{len(outcomes):,}", f"{len(planned):,}")
        settings = {key: value for key, value in resolved(cfg.physics).items() if key != "_target_"}
        result["physics"] = {"method": physics.name, "settings": settings, **summarise_physics(outcomes)}
    if other:
        result["paired_difference"] = paired_difference(result, other)
    table = evaluation_table(result)
    log.info("\n%s", table)  # before anything is written: the disk may be full
    texts = {EVALUATION: json.dumps(result, indent=1, default=to_json), "evaluation.md": table}
    if replay:
        how = f", carried out by {physics.name}" if physics else ""
        title = f"{cfg.checkpoint or planner.name}, {ev.stream} stream, seed {ev.seed}{how}"
        texts["replay.html"] = page(recordings[:replay], cell, title)
    if plans:
        texts[PLANS] = to_lines(planned)
    try:
        for name, text in texts.items():
            with replaced_file(run_dir / name) as new:
                new.write_text(text, encoding="utf-8")
        with replaced_file(run_dir / "tote.png") as new:
            picture(recordings[0], cell, new)
        if gif:
            with replaced_file(run_dir / "replay.gif") as new:
                animation(recordings[0], cell, new)
    except OSError as error:
        raise ValueError(f"{sentence(error)} The table above and the files that are there are whole.") from error
    log.info("run folder: %s", run_dir)
    return result["occupancy"]["mean"]


def prepare(cfg: DictConfig) -> tuple[MakeEnv, BatchPlanner, dict[str, Any]]:
    """Return what a config evaluates (``conf/evaluate.yaml``): the environment's maker, the planner, and facts.

    The groups that a checkpoint brings are put into ``cfg``.

    Raises:
        ValueError: for settings that make no sense, or a checkpoint that does not fit them.
    """
    ev = cfg.evaluation
    check_episode_settings(ev)
    if "model" in cfg and cfg.checkpoint is None:
        raise ValueError("model: there are no settings of a model without checkpoint=<run folder>.")
    own_modules(cfg.trust)
    use_machine(cfg)
    settings = {key: value for key, value in resolved(cfg.planner).items() if key != "_target_"}
    facts: dict[str, Any] = {"planner_settings": settings, "checkpoint": None}
    trained = None
    if cfg.checkpoint is not None:
        trained, facts_of_training = load_trained(cfg)
        facts |= facts_of_training
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
    check_play(ev, probe.cell, cfg.device)
    parts = planner_parts(cfg.planner, probe.cell, items, probe.terms, trained)
    planner = build("planner", cfg.planner, **parts)
    if not isinstance(planner, BatchPlanner) or not isinstance(planner.name, str):  # now, not after all episodes
        raise ValueError(f"planner: {type(planner).__name__} has no name; expected an attribute name, a string.")
    if hasattr(planner, "evaluation_facts"):
        facts |= planner.evaluation_facts()
    return make_env, planner, facts


def load_trained(cfg: DictConfig) -> tuple[tuple[DictConfig, dict, dict], dict[str, Any]]:
    """Return the parts of a checkpoint as :func:`planner_parts` wants them, and facts about its training.

    The checkpoint's groups :data:`TRAINED` are put into ``cfg``, with the command line's overrides on top.

    Raises:
        ValueError: for a checkpoint that cannot be read, or overrides that do not fit it.
    """
    folder = checkpoint.locate(str(cfg.checkpoint))
    state, saved = checkpoint.read(folder)
    trained = trusted_config(saved["config"], cfg.trust)
    groups = {key: OmegaConf.create(resolved(cfg[key])) for key in ("env", "items")}
    ours, changed = [], trained.copy()
    for word in task_overrides(HydraConfig.get()):
        key, _, option = word.lstrip("+~").partition("=")
        if key == "benchmark":
            ours += ["env=benchmark", "items=benchmark"] if option not in ("", "null") else []
        elif key in PARTS_OF_ENV:
            for name in keys_set_in_env(word):
                OmegaConf.update(changed, f"env.{name}", groups["env"][name], merge=False, force_add=True)
        elif key.split(".")[0] in TRAINED:
            ours.append(word)
            name = key.removeprefix("env.")
            if name in YOUNG_SETTINGS and name not in changed.env:  # older checkpoints lack what is to be overridden
                OmegaConf.update(changed, key, getattr(CellSpec, name), force_add=True)
    merged = apply_overrides(changed, ours, groups)
    with open_dict(cfg):
        for group in TRAINED:  # resolved where they come from: here a reference could lead elsewhere
            cfg[group] = resolved(merged[group])
    facts = {
        "checkpoint": str(folder),
        "trained": {"frames": saved["frames"], "seed": merged.seed, "commit": saved["commit"]},
        "mask_in_training": merged.algo.mask_infeasible,
        "warm_start": imitated_planner(saved["config"]),
        "first_weights": first_weights(saved["config"]),
    }
    return (cfg, state, resolved(trained.env)), facts


def evaluate(
    cfg: DictConfig, make_env: MakeEnv, planner: BatchPlanner, facts: dict, record: int = 0, heat_maps: int = 0
) -> tuple[dict, Episodes]:
    """Evaluate a planner as the config group ``evaluation`` says; return the content of ``evaluation.json``, too.

    Args:
        cfg, make_env, planner, facts: as of :func:`prepare`.
        record: how many episodes to record, the first ones.
        heat_maps: how many of these with heat maps.
    """
    ev = cfg.evaluation
    log.info("%s episodes to play with %s", f"{ev.episodes:,}", planner.name)
    result = play(make_env, planner, ev.episodes, ev.batch_size, range(record), range(heat_maps))
    report = {
        "planner": planner.name,
        **facts,
        **episode_settings(cfg),
        "episodes": len(result.occupancy),
        **summarise(result),
        **(planner.statistics() if hasattr(planner, "statistics") else {}),
        "latency_ms": decision_latency(make_env, planner, ev.latency_decisions),
        "versions": versions(),
        "commit": commit(),
    }
    return report, result


def episode_settings(cfg: DictConfig) -> dict:
    """Return the settings that determine which episodes an evaluation plays."""
    return {
        "env": {key: with_hash(value) for key, value in resolved(cfg.env).items()},
        "items": with_hash(resolved(cfg["items"])),
        "stream": cfg.evaluation.stream,
        "episodes": cfg.evaluation.episodes,
        "seed": cfg.evaluation.seed,
    }


def with_hash(node: Any) -> Any:
    """Return a part of a config with the hash of its file, if it has one: the content counts, not its place."""
    path = node.get("path") if isinstance(node, dict) else None
    if isinstance(path, str) and Path(path).is_file():
        return {**node, "sha256": hashlib.sha256(read_file(path)).hexdigest()}
    return node


def is_same(ours: Any, theirs: Any) -> bool:
    """Return whether two parts of configs agree, files by content if both know it, else by path."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        ignored = "path" if "sha256" in ours and "sha256" in theirs else "sha256"
        ours, theirs = ({key: node[key] for key in node if key != ignored} for node in (ours, theirs))
    return ours == theirs


def read_comparison(path: Path, expected: dict) -> dict:
    """Return another ``evaluation.json`` of the same episodes, for :func:`paired_difference`.

    Args:
        path: the file.
        expected: :func:`episode_settings` of the evaluation at hand.

    Raises:
        ValueError: for a file that cannot be read, or that is about other episodes.
    """
    refused = f"compare={excerpt(str(path))}: expected an evaluation.json"
    try:
        other = json.loads(read_file(path, MAX_EVALUATION, empty=False))
        cell, values, name = dict(other["env"]), other["occupancy"]["per_episode"], other.get("planner")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{refused} ({error}).") from error
    for key in ("stream", "seed", "episodes", "items"):
        if not is_same(expected[key], other.get(key)):
            found = excerpt(other.get(key))
            raise ValueError(f"compare={excerpt(str(path))}: its {key} is {found}, expected {excerpt(expected[key])}.")
    unused = {
        "support_margin": cell.get("support") not in HULL_RULES,
        "min_seal": cell.get("pick_rule") != "seal",
        "refill": cell.get("bin_items", 1) == 1,
    }
    for key in CELL_SETTINGS:
        # A setting that is younger than the file, or the checkpoint, has its default.
        default = getattr(CellSpec, key) if key in YOUNG_SETTINGS else None
        ours, theirs = (env.get(key, default) for env in (expected["env"], cell))
        if not is_same(ours, theirs) and not unused.get(key):
            raise ValueError(f"compare={excerpt(str(path))}: env.{key}={excerpt(theirs)}, expected {ours}.")
    count = expected["episodes"]
    if not isinstance(values, list) or len(values) != count or not all(is_number(v) and 0 <= v <= 1 for v in values):
        raise ValueError(f"{refused} whose occupancy.per_episode is a list of {count} numbers between 0 and 1.")
    if not is_name(name):
        raise ValueError(f"{refused} whose planner is a name to print, got {excerpt(name)}.")
    return other


def resolved(node: DictConfig) -> Any:
    """Return a part of a config as plain values."""
    return OmegaConf.to_container(node, resolve=True)


def to_json(value: Any) -> Any:
    """Return a tensor or a number of numpy's as plain values for JSON; anything else as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
