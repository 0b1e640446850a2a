"""Progress of a training: a bar on a terminal, lines elsewhere and in the log file."""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from multiprocessing import current_process
from typing import Any

log = logging.getLogger(__name__)  # of the lines
results = logging.getLogger("pickplace.results")  # of the lines that quiet=true shows, too

MIN_LINES = 20  # of a whole run
LONGEST = 1e10  # greatest remaining time that is shown; s
REFRESH = 0.1  # least time between two pictures of the bar; s

#: The parts of a line, in their order. On a narrow terminal the bar leaves out the last ones of ``FIRST``.
PARTS = {
    "share": "{:4.0%}", "frames": "{:>11,} frames", "speed": "{:6,.0f}/s", "level": "{}",
    "occupancy": "occupancy {:.3f}", "loss": "loss {:.3f}", "lr": "lr {:.1e}", "left": "{} to go",
}  # fmt: skip
FIRST = ("share", "left", "occupancy", "loss", "lr", "level", "speed", "frames")


class Progress:
    """The progress of a training, in lines of the log and in a bar.

    Args:
        frames: frames trained before.
        total: frames to train in all.
        interval: frames between lines; at most a twentieth of ``total`` is used.
        bar: see :func:`terminal_bar`; or None.
    """

    def __init__(self, frames: int, total: int, interval: int, bar: Any = None):
        self.start, self.total, self.interval = frames, total, min(interval, max(total // MIN_LINES, 1))
        self.started = self.drawn = time.perf_counter()
        self.parts: dict[str, str] = {}
        self.bar, self.task = bar, bar and bar.add_task("", total=total, completed=frames)

    def show(self, before: int, frames: int, metrics: dict, level: str) -> None:
        """Show the state after a batch.

        Args:
            before, frames: frames trained before the batch, and after it.
            metrics: of the batch; a part that they lack keeps its earlier value.
            level: name and number of the curriculum's level.
        """
        now = time.perf_counter()
        speed = (frames - self.start) / (now - self.started)
        seconds = max(self.total - frames, 0) / speed
        left = timedelta(seconds=int(min(seconds, LONGEST)))
        losses = [value for key, value in metrics.items() if key.startswith("train/loss")]
        values = {
            "share": min(frames / self.total, 1.0),  # the last batch is collected whole
            "frames": frames,
            "speed": speed,
            "level": level,
            "occupancy": metrics.get("train/occupancy"),
            "loss": sum(losses) if losses else None,
            "lr": metrics.get("train/lr"),
            "left": left,
        }
        self.parts |= {key: PARTS[key].format(value) for key, value in values.items() if value is not None}
        if has_passed(before, frames, self.interval):
            log.info(line(self.parts, FIRST, " | "))
        if self.bar and (now - self.drawn > REFRESH or frames >= self.total):
            self.drawn, room = now, self.bar.console.width - self.bar.columns[0].bar_width - 1
            texts = [line(self.parts, FIRST[:count], "  ") for count in range(len(FIRST), 1, -1)]
            text = next((each for each in texts if len(each) <= room), self.parts["share"])
            with suppress(OSError):
                self.bar.update(self.task, completed=frames, description=text, refresh=True)


def line(parts: dict[str, str], keys: tuple[str, ...], between: str) -> str:
    """Return the parts with these keys in one line."""
    return between.join(parts[key] for key in PARTS if key in keys and key in parts)


@contextmanager
def terminal_bar() -> Iterator[Any]:
    """Show a bar below the lines of the log; not in a job of a parallel sweep, or if standard output is no terminal.

    Returns:
        The bar, or None, as the value of the ``with`` statement.
    """
    is_terminal = sys.stdout is not None and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    if not is_terminal or current_process().name != "MainProcess":
        yield None
        return
    from rich import progress

    console, stdout = progress.Console(), sys.stdout
    bar = progress.Progress(
        progress.BarColumn(console.width // 6, complete_style="green", finished_style="green"),
        progress.TextColumn("{task.description}", markup=False),
        console=console,
        auto_refresh=False,
    )
    with filtered_consoles(lambda record: record.name != log.name) as handlers:
        bar.start()  # from now on sys.stdout writes above the bar
        console.show_cursor()  # a process that is killed could not show it again
        for handler in handlers:
            handler.setStream(sys.stdout)
        try:
            yield bar
        finally:
            with suppress(OSError):  # a terminal that was closed
                bar.stop()
                for handler in handlers:
                    handler.setStream(stdout)


@contextmanager
def filtered_consoles(is_shown: Callable[[logging.LogRecord], bool]) -> Iterator[list[logging.StreamHandler]]:
    """Show only some records of the log on the console in this block; log files get all.

    Returns:
        The handlers of the console, as the value of the ``with`` statement.
    """
    streams = [each for each in logging.root.handlers if isinstance(each, logging.StreamHandler)]
    handlers = [each for each in streams if each.stream is sys.stdout]
    for handler in handlers:
        handler.addFilter(is_shown)
    try:
        yield handlers
    finally:
        for handler in handlers:
            handler.removeFilter(is_shown)


def quiet_console(record: logging.LogRecord) -> bool:
    """Return whether ``quiet=true`` shows a record: warnings, errors and results."""
    return record.levelno >= logging.WARNING or record.name == results.name


def has_passed(before: int, now: int, interval: int) -> bool:
    """Return whether a multiple of ``interval`` lies in ``(before, now]``; it works for any batch size."""
    return before // interval != now // interval
