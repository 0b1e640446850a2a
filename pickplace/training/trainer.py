"""The parts of a training run, its counters, and their state in a checkpoint."""

import logging
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv

from pickplace.algorithms.base import Algorithm, BatchPosition, Task
from pickplace.algorithms.imitation import WarmStart, with_warm_start
from pickplace.common.graphs import NO_COMPILE, CompileSettings
from pickplace.common.machine import trim_memory, use_machine
from pickplace.common.validate import excerpt, expect, refuse_if
from pickplace.config.registry import build
from pickplace.envs.saved_state import check_saved_states
from pickplace.evaluation.play import Episodes, evaluation_mode, play
from pickplace.evaluation.result import confidence95
from pickplace.policies.base import EstimatesValue, Policy, as_critic, refuse_large_network
from pickplace.policies.restore import changed_settings
from pickplace.rules.state import Failure
from pickplace.runs import checkpoint, folder, provenance
from pickplace.runs.locate import locate
from pickplace.runs.loggers import check_metrics, read_csv
from pickplace.runs.resume import (
    StopRequest,
    checkpoint_config,
    checkpoint_hint,
    is_trained_alike,
    is_validated_alike,
    stale_best_frames,
)
from pickplace.training import callbacks, collectors, settings
from pickplace.training.compiled import CapturedEnv, CompiledPolicy
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.training.curriculum.transform import ToteHeightCurriculum, push_level
from pickplace.training.progress import Progress, has_passed, results, terminal_bar
from pickplace.training.report import write_report
from pickplace.views.figures import learning_curve

log = logging.getLogger(__name__)

#: Number of validations of a run whose interval is null.
VALIDATIONS = 20

#: Counters of a new run: frames and batches trained, best validation occupancy, and the latest validation.
NEW: dict[str, Any] = {"frames": 0, "iteration": 0, "best": -1.0, "latest": {}}


class Trainer:
    """The parts and counters of one training run; :func:`pickplace.training.train.run` is the loop over them.

    Args:
        cfg: the composed config, see ``conf/train.yaml``.
        run_dir: folder for checkpoints, metrics and figures.
        resume: state, facts and folder of the checkpoint to continue from; None begins a new run.

    Attributes:
        frames: environment steps so far.
        iteration: batches so far.
        best: best validation occupancy so far; -1 before the first validation.
        latest: metrics of the latest validation.
        episodes: episodes of the latest validation of this process, or None.
        ended: reason why a callback has ended the training; empty: none has.
        safe_folder: the checkpoint that was read or written last, or None.

    Raises:
        ValueError: for settings that make no sense.
    """

    def __init__(self, cfg: DictConfig, run_dir: Path, resume: tuple[dict, dict, Path | None] | None = None):
        settings.check_settings(cfg)
        self.cfg, self.run_dir, self.resumed = cfg, run_dir, resume is not None
        self.saved_config, self.resume_overrides = checkpoint_config(cfg)
        self.device = use_machine(cfg)
        # Older runs have no such settings.
        self.compile: CompileSettings = build("compile", cfg.compile) if cfg.get("compile") else NO_COMPILE
        torch.manual_seed(cfg.seed)
        self.state, facts, self.safe_folder = resume or ({}, {}, None)
        self.frames, self.iteration, self.best, self.latest = ({**NEW, **facts}[key] for key in NEW)
        self.episodes: Episodes | None = None
        # With other settings, a training that a callback had ended goes on.
        self.ended = facts.get("ended", "") if self.resumed and is_trained_alike(facts, self.saved_config) else ""
        alike = is_validated_alike(facts, self.saved_config) if self.resumed else True
        self.callbacks = callbacks.make_callbacks(cfg.get("callbacks") or {}, facts.get("callbacks") or {}, alike)
        # The order of these fixes the random draws of a seed.
        self._make_environments()
        self._make_networks()
        if self.resumed:
            self.curriculum.load_state_dict(facts["curriculum"])
            self.best = self._best_before(facts)
        shortage = self.curriculum.check_budget(cfg.total_frames, self.task.batch_frames)
        for warning in (*self.curriculum.unused_settings(), *([shortage] if shortage else [])):
            log.warning(warning)
        self.acting = self.algorithm.acting_policy()
        if self.compile != NO_COMPILE:
            self.acting = CompiledPolicy(self.acting, self.compile)
        base_env = partial(self.build_training_env, masks=self.policy.masks, episode_stride=cfg.env.num_envs)
        self.collector = build(
            "collector",
            cfg.collector,
            make_env=partial(training_env, base_env, self.curriculum, self.compile),
            policy=self.acting,
            num_envs=cfg.env.num_envs,
            rollout_length=cfg.rollout_length,
            seed=cfg.seed,
            next_keys=self.algorithm.next_keys,
        )

    def _make_environments(self) -> None:
        """Make the environment of the full task, the curriculum, and an environment that plays its levels."""
        cfg = self.cfg
        env = cast(dict, OmegaConf.to_container(cfg.env, resolve=True))
        del env["num_envs"]  # given with each call
        self.build_env = partial(build, "env", env, items=build("items", cfg["items"]), device=cfg.device, masks=())
        self.env = self.build_env(num_envs=1)  # for its sizes, terms and items
        self.curriculum: Curriculum = build("curriculum", cfg.curriculum)
        self.curriculum.setup(self.env.cell, self.env.items, cfg.total_frames)
        levels = self.curriculum.levels
        changes = {"items": levels.items, "varies": levels.varies} if levels.varies else {}
        self.build_training_env = partial(self.build_env, **changes)
        self.training_env = self.build_training_env(num_envs=1)

    def _make_networks(self) -> None:
        """Make the policy, the planner that validates it, the warm start, critic and algorithm."""
        cfg, env, weights = self.cfg, self.training_env, self.state
        if not self.resumed and (path := cfg.warm_start.weights) is not None:
            weights, facts = checkpoint.read(locate(path, key="warm_start.weights"))
            log.info("beginning with the weights of %s, after %s frames", path, f"{facts['frames']:,}")
            for key, now, before in changed_settings(self.saved_config, facts["config"], "critic" in weights):
                log.info("%s is %s; those weights were trained with %s", key, excerpt(now), excerpt(before))
        make = partial(build, cell=env.cell)
        make_actor = partial(make, "model.actor", cfg.model.actor, mask_infeasible=cfg.model.mask_infeasible)
        self.policy: Policy = self._restored("policy", make_actor, weights)
        for warning in self.policy.check_sizes():
            log.warning("%s The training goes on all the same.", warning)
        full = self.env.cell
        self.validated = self.policy.with_cell(full)
        self.planner = build("planner", cfg.planner, cell=full, policy=self.validated)
        self.warm_start = WarmStart(cfg.warm_start, self.policy, env, cfg.seed, cfg.trust, self.frames)
        self.critic = None
        if isinstance(self.policy, EstimatesValue):
            expect(cfg.model.critic is None, "model.critic", cfg.model.critic, "null; the actor is the critic")
            self.critic = as_critic(self.policy.value_network())
        elif cfg.model.critic is not None:
            self.critic = self._restored("critic", lambda: as_critic(make("model.critic", cfg.model.critic)), weights)
        observation = self.build_training_env(num_envs=1, masks=self.policy.masks).observation_spec.zero()
        self.task = Task(env.terms, observation, cfg.reward_scale, cfg.env.num_envs, cfg.rollout_length, self.compile)
        algorithm = build("algo", cfg.algo, policy=self.policy, critic=self.critic, task=self.task)
        expect(isinstance(algorithm, Algorithm), "algo", algorithm, "an algorithm, such as algo=ppo")
        checkpoint.check_state(algorithm.state_dict(), "algo: its state")  # now, not when it is resumed
        checkpoint.check_loads(algorithm, "algo")
        self.algorithm = with_warm_start(algorithm, self.warm_start)
        settings.check_memory(cfg, self.env, self.policy, self.algorithm)

    def _restored(self, key: str, make, weights: dict) -> Any:
        """Make a module, with the weights of the checkpoint from which the run continues or begins."""
        refuse_large_network(make, f"model.{'actor' if key == 'policy' else key}")
        what = key if self.resumed else f"{key} in warm_start.weights={self.cfg.warm_start.weights}"
        try:
            return (checkpoint.restore(make, weights.get(key, {}), what) if weights else make()).to(self.device)
        except checkpoint.CheckpointError as error:
            if self.resumed or key == "policy":
                raise
            log.warning("the critic begins anew. %s", error)
            return make().to(self.device)

    def _best_before(self, facts: dict) -> float:
        """Return the best validation occupancy so far, on the episodes that are played from now on."""
        if (stale := stale_best_frames(self.run_dir, self.frames, self.saved_config)) is not None:
            log.warning(
                "checkpoints/best is of frame %s and of other settings; the next validation replaces it", f"{stale:,}"
            )
            return NEW["best"]
        if is_validated_alike(facts, self.saved_config):
            return self.best
        try:
            best, _ = checkpoint.read(locate(self.run_dir))
        except checkpoint.CheckpointError:
            return NEW["best"]
        now = {key: value.clone() for key, value in self.policy.state_dict().items()}
        self.policy.load_state_dict(checkpoint.matching_state(best.get("policy"), now, "policy"))
        occupancy = validation_metrics(self.validate())["occupancy"]
        self.policy.load_state_dict(now)
        log.info("validated otherwise from now on: checkpoints/best has %.4f instead of %.4f", occupancy, self.best)
        return occupancy

    @property
    def is_complete(self) -> bool:
        """Whether nothing is left to train."""
        return bool(self.ended) or self.frames >= self.cfg.total_frames

    def end(self, reason: str) -> None:
        """End the training after this batch, for a callback; it is validated, saved and reported as a complete one.

        Args:
            reason: a sentence for the log; if the budget is not spent, also for the report and the learning curve.
        """
        log.info("%s frames: %s", f"{self.frames:,}", reason)
        if self.frames < self.cfg.total_frames:
            self.ended = reason or "by a callback"

    @contextmanager
    def running(self) -> Iterator[StopRequest]:
        """Prepare everything for the loop, and close it afterwards, however the loop ends.

        Restores the checkpoint, opens the logger, takes over the signals to stop, and watches the workers.

        Returns:
            The request to stop, as the value of the ``with`` statement.
        """
        with ExitStack() as cleanup:
            cleanup.callback(self.collector.shutdown)
            if self.resumed:
                self.algorithm.load_state_dict(self.state.get("algorithm"))
                with collectors.watch_workers(self.collector):
                    saved = checkpoint.matching_state(
                        self.state.get("collector"), self.collector.state_dict(), "collector"
                    )
                    check_saved_states(self.training_env, saved)
                    self.collector.load_state_dict(saved)
                    push_level(self.collector, self.curriculum.level, self.curriculum.weights)
                # Building the collector has made a step, which may have changed buffers, such as running means.
                for key, module in (("policy", self.policy), ("critic", self.critic)):
                    if module is not None:
                        module.load_state_dict(self.state[key])
                # Last: everything above may have drawn.
                random = checkpoint.matching_state(self.state, collectors.rng_state(self.device), "random generator")
                collectors.set_rng_state(random, self.device)
                self.state = {}  # not needed any more
            with checkpoint_hint(lambda: self.safe_folder, self.resume_overrides, OSError):
                shown = OmegaConf.to_container(self.cfg, resolve=True)
                self.logger = build("logger", self.cfg.logger, folder=self.run_dir, frames=self.frames, settings=shown)
            stop = StopRequest()
            # Frames of checkpoints/last, or None.
            self.last_saved = self.frames if self.safe_folder is None or "last" in self.safe_folder.name else None
            cleanup.callback(stop.restore)
            cleanup.callback(self.logger.close)
            if self.ended:
                log.info("a callback ended this training at %s frames; other settings continue it", f"{self.frames:,}")
            elif self.is_complete:
                log.info("this training is complete; total_frames above %s continues it", self.frames)
            else:
                left, now = max(self.cfg.total_frames - self.frames, 0), self.curriculum
                log.info("%s frames to train, at %s %d of %d", f"{left:,}", now.level_name, now.level, now.end)
            bar = None if self.cfg.get("quiet") else cleanup.enter_context(terminal_bar())
            self.progress = Progress(self.frames, self.cfg.total_frames, self.cfg.progress_interval, bar)
            cleanup.enter_context(checkpoint_hint(lambda: self.safe_folder, self.resume_overrides))
            cleanup.enter_context(collectors.watch_workers(self.collector))
            yield stop

    def learn(self, batch: TensorDictBase) -> dict:
        """Count a batch ``[N, T]``, move the curriculum by it and learn from it; return metrics."""
        position = BatchPosition(self.frames, self.frames + batch.numel(), self.iteration + 1, self.cfg.total_frames)
        self.frames, self.iteration, level = position.frames, position.iteration, self.curriculum.level
        done = batch["next", "done"][..., 0]
        key, weights = self.curriculum.levels.key, self.curriculum.weights
        levels, occupancy = (batch["next", entry][done][:, 0] for entry in (key, "occupancy"))
        metrics = episode_metrics(batch) | self.curriculum.update(levels, occupancy, self.frames)
        if (self.curriculum.level, self.curriculum.weights) != (level, weights):
            push_level(self.collector, self.curriculum.level, self.curriculum.weights)
        if self.curriculum.level != level:
            tell = log.debug if self.curriculum.weights else log.info  # drawn levels change all the time
            tell("%s frames: %s %d -> %d", f"{self.frames:,}", self.curriculum.level_name, level, self.curriculum.level)
            callbacks.call(self.callbacks, "on_level_change", self, level, self.curriculum.level)
        check_metrics("algo", learnt := self.algorithm.learn(batch, position))
        taken = ", ".join(sorted(metrics.keys() & learnt.keys()))
        refuse_if(taken, f"algo: it logs {taken}, which the training logs itself; expected other names.")
        return metrics | learnt

    def validate(self, record=()) -> Episodes:
        """Play the full task on the validation stream, and record the episodes of these numbers."""
        evaluation = self.cfg.evaluation
        make_env = partial(self.build_env, stream=evaluation.stream, seed=evaluation.seed)
        with evaluation_mode(self.policy, self.validated):
            return play(
                lambda first, count: make_env(first_episode=first, num_envs=count),
                self.planner, evaluation.episodes, evaluation.batch_size, record,
            )  # fmt: skip

    def finish_batch(self, metrics: dict, before: int) -> None:
        """Validate, log, save and print progress if their intervals ended between ``before`` and now."""
        cfg, frames = self.cfg, self.frames
        trim_memory()
        callbacks.call(self.callbacks, "on_batch", self, metrics)
        interval = cfg.evaluation_interval or -(-cfg.total_frames // VALIDATIONS)
        if self.is_complete or has_passed(before, frames, interval):
            self.episodes = self.validate()
            self.latest = validation_metrics(self.episodes)
            metrics |= {f"eval/{key}": value for key, value in self.latest.items()}
            log.info("%s frames: validation occupancy %.4f", f"{frames:,}", self.latest["occupancy"])
            callbacks.call(self.callbacks, "on_validation", self, self.episodes, metrics)
        # Whatever counts as a number, such as true or a numpy float, is written as one.
        self.logger.log({key: each if type(each) is int else float(each) for key, each in metrics.items()}, frames)
        # After the row was logged: a run that is resumed from this checkpoint needs it.
        if "eval/occupancy" in metrics and self.latest["occupancy"] > self.best:
            self.best = self.latest["occupancy"]
            self.save("best")
        if has_passed(before, frames, cfg.checkpoint_interval):
            self.save("last")
        if not self.ended:
            level = f"{self.curriculum.level_name} {self.curriculum.level}/{self.curriculum.end}"
            self.progress.show(before, frames, metrics, level)

    def save(self, name: str) -> None:
        """Write the checkpoint ``checkpoints/<name>``; a ``last`` keeps the one before it as ``previous``."""
        state = {
            "policy": self.policy.state_dict(),
            **({} if self.critic is None else {"critic": self.critic.state_dict()}),
            "algorithm": self.algorithm.state_dict(),
            "collector": self.collector.state_dict(),
            **collectors.rng_state(self.device),
        }
        facts = {
            **{key: getattr(self, key) for key in NEW},
            "curriculum": self.curriculum.state_dict(),
            "callbacks": callbacks.saved_states(self.callbacks),
            "ended": self.ended,
            "config": self.saved_config,
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        }
        place = self.run_dir / "checkpoints" / name
        checkpoint.write(place, state, facts, checkpoint.PREVIOUS if name == "last" else None)
        self.safe_folder = place
        if name == "last":
            self.last_saved = self.frames

    def report(self, stopped: bool) -> None:
        """Log how the run ended, draw the learning curve, and write ``report.html`` of a complete run if it is not up
        to date.

        Args:
            stopped: whether a signal has ended the loop.
        """
        run_dir, end, table = self.run_dir, self.curriculum.end, self.run_dir / "metrics.csv"
        rows = read_csv(table) if table.is_file() else []
        level = max([self.curriculum.level, *(int(row["curriculum/level"]) for row in rows)])  # levels may also fall
        if stopped:
            command = f"pickplace-train resume={shlex.quote(str(run_dir))}{self.resume_overrides}"
            results.info("stopped at %s frames; continue with: %s", f"{self.frames:,}", command)
        elif level < end and not self.curriculum.weights:
            log.info(
                "the curriculum came to %s %d of %d only, so the policy was not trained above it; "
                "train longer, or let a level end sooner (curriculum.advance, see docs/curriculum.md)",
                self.curriculum.level_name, level, end,
            )  # fmt: skip
        if not rows:
            return
        learning_curve(table, run_dir / "learning_curve.png", (self.curriculum.level_name, end), self.ended)
        # Without a validation, such as after logger=none, there is nothing to report.
        is_validated = self.best >= 0 and any("eval/occupancy" in row for row in rows)
        # If this process has no episodes, nothing was trained since the report was written.
        if self.is_complete and is_validated and (self.episodes is not None or not (run_dir / folder.REPORT).is_file()):
            log.info("writing the report")
            occupancy = (self.episodes or self.validate()).occupancy
            replayed = self.validate(record={int(occupancy.argmin()), int(occupancy.argmax())})
            made_with = {**provenance.versions(), "commit": provenance.commit()}
            write_report(run_dir, self.cfg, self.best, replayed, self.env.cell, made_with, self.curriculum, self.ended)


def training_env(
    base_env, curriculum: Curriculum, settings: CompileSettings, first_episode: int, num_envs: int
) -> TransformedEnv:
    """Make the environment of one collector process: slots ``first_episode ..``, under the curriculum."""
    levels = ToteHeightCurriculum(curriculum.level, curriculum.sample, curriculum.levels, curriculum.weights)
    env = base_env(first_episode=first_episode, num_envs=num_envs)
    return CapturedEnv(env, levels, settings) if settings.cudagraphs else TransformedEnv(env, Compose(levels))


def episode_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Mean reward, and of the episodes that ended in the batch: number, mean occupancy and shares of failures."""
    done = batch["next", "done"]
    metrics = {"train/reward": batch["next", "reward"].mean().item(), "train/episodes": int(done.sum())}
    if done.any():
        metrics["train/occupancy"] = batch["next", "occupancy"][done].mean().item()
        reasons = batch["next", "failure"][done]
        # Without these entries no rotation is forbidden, and no item is overloaded.
        entries = {Failure.FORBIDDEN_TURN: ("rotations", "handling"), Failure.OVERLOADED: ("handling",)}
        possible = [each for each in Failure if each not in entries or any(key in batch for key in entries[each])]
        metrics |= {f"train/failure_{each.name.lower()}": (reasons == each).float().mean().item() for each in possible}
    return metrics


def validation_metrics(episodes: Episodes) -> dict[str, float]:
    """Mean occupancy of a validation and its 95% interval."""
    low, high = confidence95(episodes.occupancy)
    return {"occupancy": float(episodes.occupancy.mean()), "ci95_low": low, "ci95_high": high}
