"""Entry points of the commands; ``--help`` is answered without waiting for torch."""

import logging
import os
import signal
import sys
from collections.abc import Callable

#: Flags that Hydra answers by itself.
ANSWERED_BY_HYDRA = {"--help", "-h", "--hydra-help", "--version"}


def train() -> None:
    """Entry point of ``pickplace-train``, see :mod:`pickplace.training.train`."""

    def load():
        if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
            from pickplace.runs.hydra_app import command

            return lambda: command("train", None)
        from pickplace.training.train import main

        return main

    _run(load)


def evaluate() -> None:
    """Entry point of ``pickplace-evaluate``, see :mod:`pickplace.evaluation.evaluate`."""

    def load():
        if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
            from pickplace.runs.hydra_app import command

            return lambda: command("evaluate", None)
        from pickplace.evaluation.evaluate import main

        return main

    _run(load)


def plan() -> None:
    """Entry point of ``pickplace-plan``, see :mod:`pickplace.robot.json_lines`."""

    def load():
        if not {"--help", "-h"} & set(sys.argv[1:]):
            import pickplace.robot.planner  # noqa: F401  torch, before Ctrl-C is an error that its import could change
        from pickplace.robot.json_lines import main

        return main

    _run(load)


def _run(load: Callable[[], Callable[[], None]]) -> None:
    """Import a command and run it. While it is imported, and after it has ended, Ctrl-C ends the process quietly."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed: its number would go to the next file that is opened
            os.open(os.devnull, os.O_RDWR)
    sys.stderr = sys.stderr or open(os.devnull, "w")
    logging.raiseExceptions = False  # no tracebacks of a closed terminal or a full disk
    handler = signal.signal(signal.SIGINT, _end) or signal.SIG_DFL
    main = load()
    signal.signal(signal.SIGINT, signal.SIG_IGN if handler == signal.SIG_IGN else signal.default_int_handler)
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        signal.signal(signal.SIGINT, _end)


def _end(*_) -> None:
    os._exit(130)
