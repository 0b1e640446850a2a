"""Kills a training over and over, and compares what it ends with: python tests/chaos.py [kills] [collector] [seed].

The processes are forked from this one, which has loaded torch already, so that a life takes a second. Each is killed at
a random moment: while it starts, after some iterations, or while it saves. The run that is taken up each time must end
as one that nothing disturbed: weights, metrics but for times, and curriculum.
"""

import contextlib
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from commands import ITERATION, SETTINGS, assert_same

from pickplace.runs.loggers import read_csv
from pickplace.training import train

UNFINISHED = ".last.new", ".last.old"  # in checkpoints/, while it saves


def life(run_dir: Path, overrides: list[str]) -> int:
    """Start a training in a process of its own; returns its number."""
    child = os.fork()
    if child:
        return child
    code = 1
    with contextlib.suppress(BaseException):
        log = os.open(run_dir.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.argv = ["pickplace-train", *overrides]
        try:
            train.main()
            code = 0
        except SystemExit as end:
            code = end.code or 0
    os._exit(code)


def rows(run_dir: Path) -> int:
    """Iterations that the metrics tell of."""
    path = run_dir / "metrics.csv"
    return len(read_csv(path)) if path.is_file() else 0


def unfinished(run_dir: Path) -> set[tuple[str, int]]:
    """Checkpoints that are half written, each by its name and when it was last written to."""
    found = set()
    for name in UNFINISHED:
        with contextlib.suppress(FileNotFoundError):
            found.add((name, (run_dir / "checkpoints" / name).stat().st_mtime_ns))
    return found


def command(run_dir: Path, settings: list[str]) -> list[str]:
    """To begin a run, or to go on with it."""
    saved = any((run_dir / "checkpoints" / name).is_dir() for name in ("last", ".last.old", "best", ".best.old"))
    return [f"resume={run_dir}"] if saved else [*settings, f"hydra.run.dir={run_dir}"]


def torment(run_dir: Path, settings: list[str], kills: int, draw: random.Random) -> dict[str, int]:
    """Kill a training so many times, and let it finish; how often it was starting, learning and saving.

    Raises:
        RuntimeError: if a life ends by itself before the last one, with what it said.
    """
    moments = {"starting": 0, "learning": 0, "saving": 0}
    for _ in range(kills):
        aim, before = draw.choice(("starting", "learning", "saving", "saving")), rows(run_dir)
        leftover = unfinished(run_dir)  # of the life before: whoever is killed next does not save because of it
        child, began = life(run_dir, command(run_dir, settings)), time.monotonic()
        patience, lives = draw.randint(1, 2), draw.uniform(0, 2)

        def saving(leftover=leftover) -> bool:
            return bool(unfinished(run_dir) - leftover)

        def due(aim=aim, before=before, began=began, patience=patience, lives=lives, saving=saving) -> bool:
            if aim == "starting":
                return time.monotonic() > began + lives
            return rows(run_dir) >= before + patience and (aim == "learning" or saving())

        while not due():
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                raise RuntimeError(f"it ended by itself, {status}: {run_dir.with_suffix('.log').read_text()[-800:]}")
            if aim != "saving" or rows(run_dir) < before + patience:
                time.sleep(0.002)
        time.sleep(draw.uniform(0, 0.004 if aim == "saving" else 0.2))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        moments["saving" if saving() else "starting" if aim == "starting" else "learning"] += 1
    child = life(run_dir, command(run_dir, settings))
    if status := os.waitpid(child, 0)[1]:
        raise RuntimeError(f"it could not finish, {status}: {run_dir.with_suffix('.log').read_text()[-800:]}")
    return moments


def chaos(folder: Path, kills: int, collector: str, seed: int) -> dict[str, int]:
    """A run that is tormented equals one that is not, and leaves nothing but what that one leaves."""
    iterations = 3 * kills + 10
    settings = [
        word for word in SETTINGS if not word.startswith(("total_frames", "checkpoint_interval", "evaluation_i"))
    ]
    settings += [f"total_frames={iterations * ITERATION}", f"checkpoint_interval={ITERATION}", f"collector={collector}"]
    settings += [f"evaluation_interval={30 * ITERATION}"]
    quiet, tormented = folder / "quiet", folder / "tormented"
    folder.mkdir(parents=True, exist_ok=True)
    if status := os.waitpid(life(quiet, command(quiet, settings)), 0)[1]:
        raise RuntimeError(f"it could not finish, {status}: {quiet.with_suffix('.log').read_text()[-800:]}")
    moments = torment(tormented, settings, kills, random.Random(seed))
    assert_same(quiet, tormented)

    def files(run_dir):
        return sorted(str(path.relative_to(run_dir)) for path in run_dir.rglob("*") if ".hydra" not in path.parts)

    assert files(quiet) == files(tormented)
    return moments


def main() -> None:
    given = sys.argv[1:]
    kills, collector, seed = given + ["100", "single", "0"][len(given) :]
    with tempfile.TemporaryDirectory() as folder:
        moments = chaos(Path(folder), int(kills), collector, int(seed))
    told = ", ".join(f"{count} while {moment}" for moment, count in moments.items())
    sys.stdout.write(
        f"collector={collector}: killed {kills} times ({told}); it ended as an undisturbed run, bit for bit\n"
    )


if __name__ == "__main__":
    main()
