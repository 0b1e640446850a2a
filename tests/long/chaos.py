"""Kill a training again and again, and compare its end with an undisturbed run.

python tests/long/chaos.py [kills] [collector] [seed]

Each process is killed at a random moment: while it starts, learns or saves; the next one resumes the run. The end must
equal that of a run that nothing disturbed: weights, curriculum, metrics except times, and the files in the run folder.
"""

import random
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from commands import ITERATION, SETTINGS, Training, assert_same  # noqa: E402

from pickplace.runs.loggers import read_csv  # noqa: E402

MOMENTS = ("starting", "learning", "saving")


def num_rows(run_dir: Path) -> int:
    """Return the number of iterations in ``metrics.csv``."""
    path = run_dir / "metrics.csv"
    return len(read_csv(path)) if path.is_file() else 0


def unfinished(run_dir: Path) -> set[tuple[str, int]]:
    """Return name and time of each checkpoint that is being written, or was when a process was killed."""
    found = set()
    for name in (".last.new", ".last.old"):
        with suppress(FileNotFoundError):
            found.add((name, (run_dir / "checkpoints" / name).stat().st_mtime_ns))
    return found


def start(run_dir: Path, settings: list[str]) -> Training:
    """Start a run, or resume it if it has saved anything."""
    saved = any((run_dir / "checkpoints" / name).is_dir() for name in ("last", ".last.old", "best", ".best.old"))
    return Training(*[f"resume={run_dir}"] if saved else [*settings, f"hydra.run.dir={run_dir}"])


def kill_once(run_dir: Path, settings: list[str], draw: random.Random) -> str:
    """Start or resume a training and kill it; return what it was doing."""
    aim = draw.choice((*MOMENTS, "saving"))
    leftover = unfinished(run_dir)  # by the process that was killed before
    wanted_rows = num_rows(run_dir) + draw.randint(1, 2)
    training = start(run_dir, settings)
    deadline = time.monotonic() + draw.uniform(0, 2)

    def is_saving() -> bool:
        return bool(unfinished(run_dir) - leftover)

    def is_due() -> bool:
        if aim == "starting":
            return time.monotonic() > deadline
        return num_rows(run_dir) >= wanted_rows and (aim == "learning" or is_saving())

    while not is_due():
        if not training.process.is_alive():
            raise RuntimeError(f"the training ended by itself: {training.end()}")
        if aim != "saving":
            time.sleep(0.002)
    time.sleep(draw.uniform(0, 0.004 if aim == "saving" else 0.2))
    training.kill()
    return "saving" if is_saving() else "starting" if aim == "starting" else "learning"


def compare(folder: Path, kills: int, collector: str, seed: int, settings: list[str] = SETTINGS) -> dict[str, int]:
    """Check that a run that is killed equals one that is not; return how often it was doing what when killed.

    Batches of ``settings`` have as many frames as those of ``SETTINGS``.
    """
    replaced = ("total_frames", "checkpoint_interval", "evaluation_interval")
    settings = [word for word in settings if not word.startswith(replaced)]
    settings += [f"collector={collector}", f"total_frames={(3 * kills + 10) * ITERATION}"]
    settings += [f"checkpoint_interval={ITERATION}", f"evaluation_interval={30 * ITERATION}"]
    quiet, killed = folder / "quiet", folder / "killed"
    start(quiet, settings).finish()
    draw = random.Random(seed)
    doing = [kill_once(killed, settings, draw) for _ in range(kills)]
    start(killed, settings).finish()
    assert_same(quiet, killed)
    files, others = (
        {path.relative_to(run) for path in run.rglob("*") if ".hydra" not in path.parts} for run in (quiet, killed)
    )
    assert files == others, files ^ others
    return {moment: doing.count(moment) for moment in MOMENTS}


def main() -> None:
    given = sys.argv[1:]
    kills, collector, seed = given + ["100", "single", "0"][len(given) :]
    with tempfile.TemporaryDirectory() as folder:
        counts = compare(Path(folder), int(kills), collector, int(seed))
    moments = ", ".join(f"{count} while {moment}" for moment, count in counts.items())
    sys.stdout.write(f"collector={collector}: killed {kills} times ({moments}); equal to an undisturbed run\n")


if __name__ == "__main__":
    main()
