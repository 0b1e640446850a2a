"""The training loop of new and of resumed runs."""

import logging
import sys
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path

from omegaconf import DictConfig
from tensordict import TensorDict

from pickplace.common.graphs import NO_COMPILE
from pickplace.common.validate import expect
from pickplace.runs import checkpoint, folder
from pickplace.runs.locate import locate
from pickplace.runs.resume import checkpoint_hint, interrupted_run, resumed_config, resumed_place
from pickplace.training.progress import filtered_consoles, quiet_console, results
from pickplace.training.trainer import Trainer

log = logging.getLogger(__name__)


def train(cfg: DictConfig, run_dir: Path) -> float:
    """Train a policy by a config, in a run folder that no other process trains in.

    Args:
        cfg: the composed config, see ``conf/train.yaml``.
        run_dir: folder for checkpoints, metrics and figures.

    Returns:
        Mean occupancy of the final policy at full tote height on the validation stream, which sweepers optimise.

    Raises:
        ValueError: for settings that make no sense, or a run folder that holds another training.
        KeyboardInterrupt: see :func:`run`.
    """
    expect(cfg.resume is None, "resume", cfg.resume, "as resume=<run folder> on the command line, without a +")
    with folder.claim(run_dir):
        return run(cfg, run_dir, interrupted_run(cfg, run_dir))


def run(cfg: DictConfig, run_dir: Path, resume: tuple[dict, dict, Path] | None = None) -> float:
    """Train from the beginning or from a checkpoint.

    Args:
        cfg, run_dir: as in :func:`train`.
        resume: state, facts and folder of the checkpoint to continue from.

    Returns:
        As :func:`train`.

    Raises:
        KeyboardInterrupt: with the number of the signal that asked to stop; the checkpoint ``last`` is saved.
    """
    (run_dir / folder.FAILURE).unlink(missing_ok=True)  # left by a failed job of a sweep
    with filtered_consoles(quiet_console) if cfg.get("quiet") else nullcontext():
        return _run(cfg, run_dir, resume)


def _run(cfg: DictConfig, run_dir: Path, resume: tuple[dict, dict, Path] | None) -> float:
    trainer = Trainer(cfg, run_dir, resume)
    if trainer.device.type == "cuda" and trainer.compile == NO_COMPILE:
        log.info("a GPU waits for Python most of the time; with compile=cudagraphs it repeats captured steps instead")
    with trainer.running() as stop:
        batches = iter(trainer.collector)
        while not (trainer.is_complete or stop.signal):
            # Collect a batch, [num_envs, rollout_length], with the newest weights.
            trainer.collector.update_policy_weights_(TensorDict.from_module(trainer.acting).data)
            started = time.perf_counter()
            batch = next(batches)
            collected = time.perf_counter()

            # Finished episodes move the curriculum; the algorithm learns.
            metrics = trainer.learn(batch)
            finished = time.perf_counter()
            metrics |= {
                "time/collect_ms": (collected - started) * 1e3,
                "time/update_ms": (finished - collected) * 1e3,
                "time/fps": batch.numel() / (finished - started),
            }

            # On their intervals: validate, save, print progress.
            trainer.finish_batch(metrics, trainer.frames - batch.numel())
        if trainer.last_saved != trainer.frames:  # after the loop, so that a stop request is never missed
            trainer.save("last")

    with checkpoint_hint(lambda: trainer.safe_folder, trainer.resume_overrides):
        trainer.report(stop.signal is not None)
    if latest := trainer.latest:
        text = "validation occupancy %(occupancy).4f (95%% interval %(ci95_low).4f to %(ci95_high).4f)"
        better = f"; best checkpoint: {trainer.best:.4f}" if trainer.best > latest["occupancy"] else ""
        results.info(text + better, latest)
    results.info("run folder: %s", run_dir)
    if stop.signal:
        raise KeyboardInterrupt(stop.signal)  # ends a whole sweep, not only this run
    return float(trainer.latest.get("occupancy", float("nan")))


def resume_run(overrides: list[str]) -> float:
    """Continue a run in its own folder: ``resume=<run folder>`` and overrides of values of its saved config.

    Returns:
        As :func:`train`.

    Raises:
        ValueError: for a folder that is no run, or a change that a resumed run does not support. If nothing can be
            written into the folder, it names the checkpoint that is intact.
    """
    place, words = resumed_place(overrides)
    saved = locate(place, prefer="last")
    run_dir, expected = saved.parent.parent, "a run folder, or one of its checkpoints: last, best or previous"
    expect(saved.parent.name == "checkpoints", "resume", place, expected)
    folder.refuse_links(run_dir)
    with ExitStack() as claimed:
        with checkpoint_hint(lambda: checkpoint.read(saved) and saved, errors=OSError):
            claimed.enter_context(folder.claim(run_dir))  # before reading what another process may be writing
            state, facts = checkpoint.read(saved)
            cfg = resumed_config(place, facts, words)
            handlers = (logging.StreamHandler(sys.stdout), logging.FileHandler(run_dir / "train.log"))
            form = "%(asctime)s %(message)s"
            logging.basicConfig(level=logging.INFO, format=form, datefmt="%H:%M:%S", handlers=handlers)
        log.info("resuming %s at %s frames", run_dir, f"{facts['frames']:,}")
        return run(cfg, run_dir, (state, facts, saved))
