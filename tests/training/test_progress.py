"""What a training shows: a bar on a terminal, lines elsewhere, and little with quiet=true."""

import io
import logging
import re
import sys

import pytest
from commands import TINY

from pickplace.training.progress import Progress, filtered_consoles, quiet_console, results, terminal_bar

METRICS = {"train/occupancy": 0.8125, "train/loss_policy": 0.5, "train/loss_critic": 0.25, "train/lr": 0.002}


class Terminal(io.StringIO):
    def isatty(self):
        return True


def use_terminal(monkeypatch, columns=80):
    """Let standard output be a terminal, to which the log is written; return it, and the handler of the log."""
    monkeypatch.setattr(sys, "stdout", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    handler = logging.StreamHandler(sys.stdout)
    monkeypatch.setattr(logging.root, "handlers", [handler])
    monkeypatch.setattr(logging.root, "level", logging.INFO)
    return sys.stdout, handler


def show(progress, batch=10, total=1000):
    for frames in range(batch, total + 1, batch):
        progress.show(frames - batch, frames, METRICS if frames == batch else {}, "tote height 3/5")


def test_lines_come_at_least_every_twentieth_of_a_run(caplog):
    caplog.set_level(logging.INFO)
    with terminal_bar() as bar:  # none: standard output is no terminal
        assert bar is None
        show(Progress(0, 1000, 10**6, bar))
    assert [line.split("%")[0].strip() for line in caplog.messages] == [str(share) for share in range(5, 101, 5)]
    words = ["%", "frames", "/s", "tote height 3/5", "occupancy 0.812", "loss 0.750", "lr 2.0e-03", "to go"]
    for line in caplog.messages:  # of the latest batch that had them
        assert all(word in part for word, part in zip(words, line.split(" | "), strict=True)), line
    caplog.clear()
    show(Progress(0, 1000, 20, bar))
    assert len(caplog.messages) == 50


def test_a_budget_that_no_run_can_spend_is_shown(caplog):
    caplog.set_level(logging.INFO)
    progress = Progress(0, 2**63 - 1, 10)
    progress.started -= 1  # 10 frames a second
    progress.show(0, 10, {}, "level 1/1")
    assert caplog.messages[0].startswith("  0% |") and "days" in caplog.messages[0]


@pytest.mark.parametrize(
    ("columns", "shown", "left_out"),
    [
        (60, "occupancy 0.812  loss 0.750", "lr"),
        (71, "occupancy 0.812  loss 0.750", "lr"),
        (80, "loss 0.750  lr 2.0e-03", "tote"),
        (140, "tote height 3/5", "|"),
    ],
)
def test_a_terminal_gets_a_bar_that_fits_and_no_lines(monkeypatch, columns, shown, left_out):
    stdout, handler = use_terminal(monkeypatch, columns)
    with terminal_bar() as bar:
        assert stdout.getvalue().endswith("\x1b[?25h")  # the cursor is visible, should the process be killed
        progress = Progress(0, 1000, 100, bar)
        show(progress, 500)
        logging.info("a validation")
    out = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stdout.getvalue())
    pictures = re.split("[\r\n]+", out)
    assert all(len(picture) <= columns for picture in pictures)
    assert "100%" in pictures[-2] and shown in pictures[-2] and left_out not in pictures[-2]
    assert pictures.count("a validation") == 1 and " | " not in out
    logging.info("after it")
    assert sys.stdout is handler.stream is stdout and stdout.getvalue().endswith("after it\n") and not handler.filters


def test_a_terminal_that_cannot_move_its_cursor_gets_lines(monkeypatch):
    use_terminal(monkeypatch)
    monkeypatch.setenv("TERM", "dumb")
    with terminal_bar() as bar:
        assert bar is None


def test_closed_standard_output_gets_no_bar(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with terminal_bar() as bar:
        assert bar is None


def test_an_error_ends_the_bar_and_goes_on(monkeypatch):
    stdout, handler = use_terminal(monkeypatch)
    with pytest.raises(OSError, match="disk"), terminal_bar():
        raise OSError("disk")
    assert sys.stdout is stdout and not handler.filters


def test_quiet_shows_warnings_and_results_only(monkeypatch):
    stdout, _ = use_terminal(monkeypatch)
    with filtered_consoles(quiet_console):
        logging.info("a line")
        logging.warning("a warning")
        results.info("a result")
    assert stdout.getvalue() == "a warning\na result\n"


def test_a_quiet_training_tells_its_result(run, tmp_path, no_report):
    code, out, err = run("train", *TINY, "curriculum=none", "total_frames=32", "quiet=true", "hydra.run.dir=run")
    assert code == 0, err
    occupancy, folder = (line[9:] for line in out.splitlines())
    assert occupancy.startswith("validation occupancy 0.") and folder == f"run folder: {tmp_path / 'run'}"
    log = (tmp_path / "run" / "train.log").read_text()
    assert "50% |" in log and "| lr 2.0e-03 |" in log and " frames: validation occupancy" in log
