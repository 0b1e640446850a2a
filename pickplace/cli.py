"""Entry points of the commands; ``--help`` is answered without waiting for torch."""

import logging
import os
import signal
import sys
from importlib import import_module

# A thread that waits for others sleeps. If it spun, it would hold up those that share its core. OpenMP reads this when
# torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

#: Flags that need no torch.
HELP = {"--help", "-h", "--hydra-help", "--version"}


def train() -> None:
    """Entry point of ``pickplace-train``, see :mod:`pickplace.training.train`."""
    _run("pickplace.training.train", config_name="train")


def evaluate() -> None:
    """Entry point of ``pickplace-evaluate``, see :mod:`pickplace.evaluation.evaluate`."""
    _run("pickplace.evaluation.evaluate", config_name="evaluate")


def plan() -> None:
    """Entry point of ``pickplace-plan``, see :mod:`pickplace.serve.json_lines`."""
    _run("pickplace.serve.json_lines", "pickplace.robot.planner")


def physics() -> None:
    """Entry point of ``pickplace-physics``, see :mod:`pickplace.physics.command`."""
    _run("pickplace.physics.command")


def export() -> None:
    """Entry point of ``pickplace-export``, see :mod:`pickplace.policies.export`."""
    _run("pickplace.policies.export", "pickplace.policies.onnx_model")


def serve() -> None:
    """Entry point of ``pickplace-serve``, see :mod:`pickplace.serve.serve`."""
    _run("pickplace.serve.serve", "pickplace.robot.planner")


def _run(module: str, *needed: str, config_name: str | None = None) -> None:
    """Import a command and run it. While it is imported, and after it has ended, Ctrl-C ends the process quietly.

    Args:
        module: the command's module, with a function ``main``.
        needed: further modules to import, unless help is asked for.
        config_name: of a Hydra application, which answers a call for help by itself.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed: its number would go to the next file that is opened
            os.open(os.devnull, os.O_RDWR)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115  open until the end
    logging.raiseExceptions = False  # else each line prints a traceback on a closed terminal or a full disk
    on_interrupt = signal.SIG_IGN if signal.getsignal(signal.SIGINT) == signal.SIG_IGN else _end
    signal.signal(signal.SIGINT, on_interrupt)
    help_only = bool(HELP & set(sys.argv[1:]))
    if help_only and config_name:
        main = import_module("pickplace.config.hydra_app").Command(config_name)
    else:
        main = import_module(module).main
        for name in () if help_only else needed:
            import_module(name)
    try:
        if on_interrupt == _end:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        main()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        signal.signal(signal.SIGINT, on_interrupt)


def _end(*_) -> None:
    os._exit(130)
