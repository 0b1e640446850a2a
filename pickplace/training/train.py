"""Training by PPO, and the ``pickplace-train`` command. :func:`run` reads from top to bottom."""

import logging
import shlex
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss
from torchrl.objectives.value import GAE

from pickplace.evaluation.evaluate import commit, versions
from pickplace.evaluation.play import Episodes, play
from pickplace.evaluation.statistics import confidence95
from pickplace.policies.base import Policy, as_actor, as_collection_policy, as_critic
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.allowlist import own_modules, saved_form, trust_needed, trusted
from pickplace.runs.registry import build
from pickplace.runs.resume import (
    AT_HOME,
    COUNTERS,
    StopRequest,
    begun_already,
    best_of_another_course,
    claim,
    load_optimizer,
    refuse_links,
    resumed_config,
    saying_what_is_safe,
)
from pickplace.task.state import Failure
from pickplace.task.items import check_seed
from pickplace.training.collectors import rng_state, set_rng_state, watched
from pickplace.training.curriculum import Curriculum, push_level
from pickplace.training.imitation import Phase, WarmStart, imitation_loss
from pickplace.training.report import REPORT, write_report
from pickplace.views.figures import learning_curve

log = logging.getLogger(__name__)


def train(cfg: DictConfig, run_dir: Path) -> float:
    """Train a policy as the config says, in a run folder that no other process trains in.

    Args:
        cfg: the composed config, see ``conf/train.yaml``.
        run_dir: where checkpoints, metrics and figures go.

    Returns:
        Mean occupancy of the final policy at full tote height on the validation stream, for sweepers to optimise.

    Raises:
        ValueError: for settings that make no sense, or a run folder that holds another training.
    """
    if cfg.resume is not None:
        raise ValueError(f"resume={cfg.resume}: expected as resume=<run folder> on the command line, without a +.")
    with claim(run_dir):
        return run(cfg, run_dir, begun_already(cfg, run_dir))


def run(cfg: DictConfig, run_dir: Path, resume: tuple[dict, dict, Path] | None = None) -> float:
    """The training itself, from its beginning or from a checkpoint.

    Args:
        cfg, run_dir: as of :func:`train`.
        resume: state and facts of the checkpoint to continue from, as :func:`pickplace.runs.checkpoint.read` gives them,
            and its folder.

    Returns:
        As :func:`train`.
    """
    check_settings(cfg)
    settled_config, again = loadable(cfg)
    algo, device = cfg.algo, config.use_machine(cfg)
    torch.manual_seed(cfg.seed)

    # What is trained, and where it acts.
    items = build("items", cfg["items"])
    build_env = partial(build, "env", cfg.env, items=items, device=cfg.device)
    probe = build_env(num_envs=1, masks=())
    cell = probe.cell
    state, facts, safe = resume or ({}, {}, None)  # safe: the checkpoint that was read or written last

    def restored(what: str, make):
        return (checkpoint.restore(make, state.get(what, {}), what) if resume else make()).to(device)

    make_policy = partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=algo.mask_infeasible)
    policy: Policy = restored("policy", make_policy)
    for warning in policy.check_sizes():
        log.warning(warning)
    planner = build("planner", cfg.planner, cell=cell, policy=policy)  # the one that validates
    warm_start = WarmStart(cfg.warm_start, policy, cell, items, probe.terms, cfg.seed, cfg.trust)
    make_critic = partial(build, "model.critic", cfg.model.critic, cell=cell)
    critic = restored("critic", lambda: as_critic(make_critic()))
    curriculum: Curriculum = build("curriculum", cfg.curriculum)
    curriculum.setup(probe.min_tote_height, cell.tote_size[2], cfg.total_frames)
    frames, iteration, best, latest = (facts.get(k, d) for k, d in COUNTERS.items())
    if resume:
        curriculum.load_state_dict(facts["curriculum"])
        if (later := best_of_another_course(run_dir, frames, settled_config)) is not None:
            best = COUNTERS["best"]
            log.warning(
                "checkpoints/best, of frame %s, is of an earlier course of this run; the next validation replaces it",
                f"{later:,}",
            )
    if shortage := curriculum.check_budget(cfg.total_frames, cfg.env.num_envs * algo.rollout_length):
        log.warning(shortage)
    if learning_rate(algo, cfg.env.num_envs * algo.rollout_length, cfg.total_frames) == 0 < algo.lr:
        log.warning(
            "total_frames=%d: one batch, for which algo.lr has fallen to 0; nothing is learnt", cfg.total_frames
        )

    # TorchRL's parts: collector, advantage, loss.
    env_config = OmegaConf.to_container(cfg.env, resolve=True)
    make_env = partial(training_env, env_config, items, cfg.device, policy.masks, cfg.env.num_envs, curriculum)
    acting = as_collection_policy(policy)
    advantage, loss = make_losses(algo, policy, critic)
    learned = [*policy.in_keys, policy.choice_key, "log_prob", "advantage", "value_target"]
    optimizer = torch.optim.Adam(loss.parameters(), lr=algo.lr, eps=1e-5)
    collector = build(
        "collector",
        cfg.collector,
        make_env=make_env,
        policy=acting,
        num_envs=cfg.env.num_envs,
        rollout_length=algo.rollout_length,
        seed=cfg.seed,
    )
    episodes = None  # of the latest validation

    def save(name: str) -> None:
        nonlocal safe
        state = {
            "policy": policy.state_dict(),
            "critic": critic.state_dict(),
            "optimizer": optimizer.state_dict()["state"],
            "collector": collector.state_dict(),
            **rng_state(device),
        }
        facts = {
            **dict(zip(COUNTERS, (frames, iteration, best, latest), strict=True)),
            "curriculum": curriculum.state_dict(),
            "config": settled_config,
            "versions": versions(),
            "commit": commit(),
        }
        keep = checkpoint.PREVIOUS if name == "last" else None
        checkpoint.write(run_dir / "checkpoints" / name, state, facts, keep)
        safe = run_dir / "checkpoints" / name

    with ExitStack() as cleanup:
        cleanup.callback(collector.shutdown)
        if resume:
            load_optimizer(optimizer, state.get("optimizer", {}))
            with watched(collector):
                mine = collector.state_dict()
                collector.load_state_dict(checkpoint.fitting(state.get("collector"), mine, "collector"))
                push_level(collector, curriculum.level)
            # Last: everything above may have drawn.
            set_rng_state(checkpoint.fitting(state, rng_state(device), "random generator"), device)
        settings = OmegaConf.to_container(cfg, resolve=True)
        logger = build("logger", cfg.logger, folder=run_dir, frames=frames, settings=settings)
        stop, started, first_frames = StopRequest(), time.perf_counter(), frames
        saved = frames if safe is None or "last" in safe.name else None  # the frames of `last`
        cleanup.callback(stop.restore)
        cleanup.callback(logger.close)
        left = max(cfg.total_frames - frames, 0)
        log.info("%s frames to train, at tote height %d of %d", f"{left:,}", curriculum.level, curriculum.end)
        cleanup.enter_context(saying_what_is_safe(lambda: safe, again))
        cleanup.enter_context(watched(collector))
        batches = iter(collector)
        while frames < cfg.total_frames and not stop.requested:
            # Collect a batch, [num_envs, rollout_length].
            collector.update_policy_weights_(TensorDict.from_module(acting).data)
            began = time.perf_counter()
            batch = next(batches)
            collected = time.perf_counter()
            phase = warm_start.phase(frames)
            before, frames, iteration = frames, frames + batch.numel(), iteration + 1
            metrics = episode_metrics(batch)

            # Finished episodes move the curriculum.
            done = batch["next", "done"][..., 0]
            heights, occupancy = (batch["next", key][done][:, 0] for key in ("tote_height", "occupancy"))
            level = curriculum.level
            metrics |= curriculum.update(heights, occupancy, frames)
            if curriculum.level != level:
                push_level(collector, curriculum.level)
                log.info("%s frames: tote height %d -> %d", f"{frames:,}", level, curriculum.level)

            # Learn: advantages (and what the teacher would do) once, then epochs of shuffled minibatches.
            batch["next", "reward"] = batch["next", "reward"] * algo.reward_scale
            batch["next", "terminated"] |= bin_is_empty(batch["next"])
            with torch.no_grad():
                advantage(batch)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(algo, frames, cfg.total_frames)
            data = batch.select(*learned).reshape(-1)
            if phase == Phase.IMITATION:
                data["taught"] = warm_start.ask(batch.reshape(-1), iteration)
            metrics |= update(loss, optimizer, data, algo, policy, phase)
            metrics["train/lr"] = optimizer.param_groups[0]["lr"]
            metrics["time/collect_ms"] = (collected - began) * 1e3
            metrics["time/update_ms"] = (time.perf_counter() - collected) * 1e3
            metrics["time/fps"] = batch.numel() / (time.perf_counter() - began)

            # On intervals: validate, save, tell.
            finished = frames >= cfg.total_frames
            if finished or crossed(before, frames, cfg.evaluation_interval):
                episodes = validate(cfg, build_env, planner)
                latest = validation_metrics(episodes)
                metrics |= {f"eval/{key}": value for key, value in latest.items()}
                log.info("%s frames: validation occupancy %.4f", f"{frames:,}", latest["occupancy"])
            logger.log(metrics, frames)
            # After its row, which a run that goes on from here needs.
            if "eval/occupancy" in metrics and latest["occupancy"] > best:
                best = latest["occupancy"]
                save("best")
            if crossed(before, frames, cfg.checkpoint_interval):
                save("last")
                saved = frames
            if crossed(before, frames, cfg.progress_interval):
                speed = (frames - first_frames) / (time.perf_counter() - started)
                log.info(progress_line(frames, cfg.total_frames, speed, curriculum, metrics))
        if saved != frames:  # after the loop, so that a stop request is never missed
            save("last")

    if stop.requested:  # a sweep ends here too, instead of going on to its next job
        command = f"pickplace-train resume={shlex.quote(str(run_dir))}{again}"
        log.info("stopped at %s frames; continue with: %s", f"{frames:,}", command)
    elif curriculum.level < curriculum.end:
        log.info(
            "the tote grew to height %d of %d only, so the policy was trained on no higher one; "
            "train longer, or let a level end sooner (curriculum.advance, see docs/curriculum.md)",
            curriculum.level,
            curriculum.end,
        )
    if (run_dir / "metrics.csv").is_file():
        learning_curve(run_dir / "metrics.csv", run_dir / "learning_curve.png")
        told = episodes is None and (run_dir / REPORT).is_file()  # by the process before this one
        if frames >= cfg.total_frames and not told:
            log.info("writing the report")
            episodes = episodes or validate(cfg, build_env, planner)
            extremes = {int(episodes.occupancy.argmin()), int(episodes.occupancy.argmax())}
            replayed = validate(cfg, build_env, planner, record=extremes)
            write_report(run_dir, cfg, replayed, cell, versions() | {"commit": commit()})
    log.info("run folder: %s", run_dir)
    if stop.requested and HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise KeyboardInterrupt
    return float(latest.get("occupancy", float("nan")))


def check_settings(cfg: DictConfig) -> None:
    """Refuse numbers that make no sense before anything is built.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    at_least = {
        "total_frames": 1, "evaluation_interval": 1, "checkpoint_interval": 1, "progress_interval": 1,
        "env.num_envs": 1, "algo.rollout_length": 1, "algo.epochs": 1, "algo.minibatch_size": 1,
        "evaluation.episodes": 1, "evaluation.batch_size": 1,
    }  # fmt: skip
    for key, least in at_least.items():
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 2**63:
            raise ValueError(f"{key}={value}: expected a whole number >= {least} and < 2**63.")
    check_seed(cfg.seed)
    check_seed(cfg.evaluation.seed, "evaluation.seed")
    own_modules(cfg.trust)
    for key in ("items", "env", "model.actor", "model.critic", "curriculum", "collector", "planner", "logger"):
        if not OmegaConf.is_dict(node := OmegaConf.select(cfg, key)) or "_target_" not in node:
            raise ValueError(f"{key}={node}: expected the settings of something to make, with a _target_.")
    if cfg.algo.loss not in ("a2c", "ppo"):
        raise ValueError(f"algo.loss={cfg.algo.loss}: expected ppo or a2c.")
    for key in ("algo.mask_infeasible", "algo.normalize_advantage"):
        if not isinstance(value := OmegaConf.select(cfg, key), bool):
            raise ValueError(f"{key}={value}: expected true or false.")
    if cfg.planner._target_ != "pickplace.planners.policy.PolicyPlanner":
        raise ValueError(
            f"planner._target_={cfg.planner._target_}: training validates its policy; expected planner=policy."
        )
    if cfg.evaluation.stream != "validation":
        raise ValueError(f"evaluation.stream={cfg.evaluation.stream}: training picks its best policy on validation.")
    start = cfg.algo.lr_decay_start
    if start is not None and (isinstance(start, bool) or not isinstance(start, (int, float)) or not 0 <= start <= 1):
        raise ValueError(f"algo.lr_decay_start={start}: expected a share of total_frames between 0 and 1, or null.")
    ranges = {
        "algo.gamma": (0, 1), "algo.lmbda": (0, 1), "algo.lr": (0, None), "algo.clip_epsilon": (0, 1),
        "algo.entropy_coeff": (0, None), "algo.critic_coeff": (0, None), "algo.max_grad_norm": (0, None),
        "algo.reward_scale": (0, None),
    }  # fmt: skip
    for key, (low, high) in ranges.items():
        value = OmegaConf.select(cfg, key)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not low <= value < float("inf") or (high is not None and value > high):
            raise ValueError(f"{key}={value}: expected a number >= {low}{'' if high is None else f' and <= {high}'}.")
    if cfg.algo.loss == "a2c" and cfg.algo.normalize_advantage and cfg.env.num_envs * cfg.algo.rollout_length == 1:
        raise ValueError(
            "algo.normalize_advantage=True: a batch of one frame (env.num_envs x algo.rollout_length) has no variance; "
            "expected more frames, or false."
        )


def loadable(cfg: DictConfig) -> tuple[dict, str]:
    """The config as checkpoints hold it, and what has to be said to resume one, such as `` trust=[...]``; or nothing.

    What could be saved but never be loaded is told now, not after hours.
    """
    content = saved_form(cfg)
    own = trust_needed(OmegaConf.to_container(cfg, resolve=True))
    try:
        trusted(content, own)
    except ValueError as error:
        log.warning("checkpoints of this run will not be loaded again: %s", error)
    said = {key: OmegaConf.select(cfg, key) for key in AT_HOME}
    words = [f" {key}={value}" for key, value in said.items() if value not in AT_HOME[key]]
    return content, "".join([f" trust=[{','.join(own)}]" if own else "", *words])


def make_losses(algo: DictConfig, policy: Policy, critic: ValueOperator) -> tuple[GAE, A2CLoss | ClipPPOLoss]:
    """The advantage estimator and the loss that ``algo.loss`` names."""
    common = {"entropy_coeff": algo.entropy_coeff, "critic_coeff": algo.critic_coeff, "loss_critic_type": "l2"}
    if algo.loss == "ppo":
        clip = {"clip_epsilon": algo.clip_epsilon, "normalize_advantage": algo.normalize_advantage}
        loss = ClipPPOLoss(as_actor(policy), critic, **clip, **common)
    else:
        loss = A2CLoss(as_actor(policy), critic, **common)
    loss.set_keys(action=policy.choice_key, sample_log_prob="log_prob")
    # A2CLoss has no normalisation of its own.
    average = algo.loss == "a2c" and algo.normalize_advantage
    advantage = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=critic, average_gae=average, deactivate_vmap=True)
    return advantage, loss


def training_env(env_config, items, device, masks, total_envs, curriculum, first_episode, num_envs) -> TransformedEnv:
    """The environment of one collector process: slots ``first_episode ..`` of ``total_envs``, under the curriculum."""
    env = build(
        "env",
        OmegaConf.create(env_config),
        items=items,
        device=device,
        masks=masks,
        num_envs=num_envs,
        first_episode=first_episode,
        episode_stride=total_envs,
    )
    return TransformedEnv(env, Compose(curriculum.transform()))


def learning_rate(algo: DictConfig, frames: int, total_frames: int) -> float:
    """``algo.lr``; if ``algo.lr_decay_start`` is set, it falls linearly over the last part, to 0 in the last batch.

    Args:
        frames: of the run, with this batch.
    """
    if algo.lr_decay_start is None:
        return algo.lr
    left = (1 - frames / total_frames) / max(1 - algo.lr_decay_start, 1e-9)
    return algo.lr * min(max(left, 0.0), 1.0)


def update(loss, optimizer, data: TensorDictBase, algo: DictConfig, policy, phase=Phase.REWARD) -> dict[str, float]:
    """The epochs over one batch of frames ``[B]``; returns the mean diagnostics.

    The loss is TorchRL's in phase ``REWARD``; its critic's part alone, with or without imitation, before.
    """
    totals: dict[str, Tensor | float] = {}
    steps = 0
    for _ in range(algo.epochs):
        for index in torch.randperm(len(data), device=data.device).split(algo.minibatch_size):
            part = data[index]
            losses = loss(part)
            total = losses["loss_critic"]
            if phase == Phase.REWARD:
                total = losses["loss_objective"] + total + losses["loss_entropy"]
            elif phase == Phase.IMITATION:
                losses["loss_imitation"], losses["agreement"] = imitation_loss(policy, part)
                total = total + losses["loss_imitation"]
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            norm = torch.nn.utils.clip_grad_norm_(loss.parameters(), algo.max_grad_norm)
            if not torch.isfinite(norm + total.detach()):
                parts = {key: value.detach() for key, value in losses.items() if key.startswith("loss_")}
                raise FloatingPointError(f"the loss or its gradient is not finite: {extremes({**parts, **part})}.")
            optimizer.step()
            steps += 1
            for name, key in DIAGNOSTICS.items():
                if key not in losses.keys():  # noqa: SIM118
                    continue
                totals[name] = totals.get(name, 0.0) + losses[key].detach()
            totals["grad_norm"] = totals.get("grad_norm", 0.0) + norm
    return {f"train/{name}": float(value) / steps for name, value in totals.items()}


def extremes(values) -> str:
    """Least and greatest of each floating-point tensor, and how much of it is not finite, for a message."""
    words = []
    for name, value in values.items():
        if value.is_floating_point():
            finite = value[value.isfinite()]
            text = f"{finite.min():.3g} to {finite.max():.3g}" if len(finite) else "no number"
            bad = value.numel() - len(finite)
            words.append(f"{name} {text}" + f" ({bad} of {value.numel()} not finite)" * bool(bad))
    return "; ".join(words)


DIAGNOSTICS = {
    "loss_objective": "loss_objective",
    "loss_critic": "loss_critic",
    "entropy": "entropy",
    "approx_kl": "kl_approx",
    "clip_fraction": "clip_fraction",
    "explained_variance": "explained_variance",
    "loss_imitation": "loss_imitation",
    "agreement": "agreement",
}


def bin_is_empty(state: TensorDictBase) -> Tensor:
    """Where no item has arrived, bool ``[..., 1]``: a recorded stream has ended.

    The environment calls that a truncation; but nothing can be gained after it, and no action is ever taken there, so
    a critic would never learn the value by which GAE continues a truncated episode.
    """
    return state["bin_depth"].flatten(-2).amax(-1, keepdim=True) == 0


def episode_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Mean reward, and over the episodes that ended in the batch: occupancy and the mix of reasons."""
    metrics = {"train/reward": batch["next", "reward"].mean().item()}
    done = batch["next", "done"]
    ended = int(done.sum())
    metrics["train/episodes"] = ended
    if ended:
        metrics["train/occupancy"] = batch["next", "occupancy"][done].mean().item()
        reasons = batch["next", "failure"][done]
        for failure in Failure:
            metrics[f"train/failure_{failure.name.lower()}"] = (reasons == failure).float().mean().item()
    return metrics


def validate(cfg: DictConfig, build_env, planner, record=()) -> Episodes:
    """Play the validation stream at full height, and record the episodes of these numbers."""
    ev = cfg.evaluation

    def make_env(first, count):
        return build_env(num_envs=count, masks=(), stream=ev.stream, seed=ev.seed, first_episode=first)

    return play(make_env, planner, ev.episodes, ev.batch_size, record)


def validation_metrics(episodes: Episodes) -> dict[str, float]:
    """What is logged of a validation."""
    low, high = confidence95(episodes.occupancy)
    return {"occupancy": float(episodes.occupancy.mean()), "ci95_low": low, "ci95_high": high}


def crossed(before: int, now: int, interval: int) -> bool:
    """Has a multiple of ``interval`` been passed? Fires whatever the batch size, unlike ``now % interval == 0``."""
    return before // interval != now // interval


def progress_line(frames: int, total: int, speed: float, curriculum: Curriculum, metrics: dict) -> str:
    """Frames, speed, level, occupancy and time to go."""
    left = int(max(total - frames, 0) / speed)  # the last batch is collected whole
    occupancy = metrics.get("train/occupancy", float("nan"))
    return (
        f"{frames / total:4.0%} {frames:>11,} frames | {speed:6,.0f}/s | "
        f"tote height {curriculum.level}/{curriculum.end} | occupancy {occupancy:.3f} | "
        f"{left // 60}:{left % 60:02d} to go"
    )


def resume_run(overrides: list[str]) -> float:
    """Continue a run in its own folder: ``resume=<run folder>`` and overrides of values on top of its saved config."""
    place = next(item for item in overrides if item.startswith("resume=")).partition("=")[2]
    folder = checkpoint.locate(place, prefer="last")
    if folder.parent.name != "checkpoints":
        raise ValueError(f"resume={place}: expected a run folder, or one of its checkpoints: last, best or previous.")
    run_dir = folder.parent.parent
    refuse_links(run_dir)
    with claim(run_dir):  # before reading what another process may be writing
        state, facts = checkpoint.read(folder)
        cfg = resumed_config(place, facts, [item for item in overrides if not item.startswith("resume=")])
        log_file = run_dir / "train.log"
        handlers: list[logging.Handler] = [logging.StreamHandler(sys.stdout), logging.FileHandler(log_file)]
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", handlers=handlers)
        (run_dir / config.FAILURE).unlink(missing_ok=True)  # of the sweep that it was part of
        log.info("resuming %s at %s frames", run_dir, f"{facts['frames']:,}")
        return run(cfg, run_dir, (state, facts, folder))


def main() -> None:
    """Entry point of ``pickplace-train``."""
    overrides = [item for item in sys.argv[1:] if not item.startswith("-")]
    if any(item.startswith("resume=") and item not in ("resume=", "resume=null") for item in overrides):
        with config.one_sentence():
            if len(overrides) < len(sys.argv) - 1:
                raise ValueError("resume=...: expected only key=value overrides beside it, no flags such as -m.")
            resume_run(overrides)
    else:
        config.command("train", train)


if __name__ == "__main__":
    # The module by its own name: what launchers and collectors send to other processes is found there.
    from pickplace.training.train import main

    main()
