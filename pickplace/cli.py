"""Entry points of the commands; ``--help`` is answered without waiting for torch."""

import logging
import os
import signal
import sys
from functools import partial
from importlib import import_module

# A thread that waits for others sleeps. If it spun, it would hold up those that share its core. OpenMP reads this when
# torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

#: Flags that need no torch.
HELP = {"--help", "-h", "--hydra-help", "--version"}


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


# Entry points of pickplace-train and so on.
train = partial(_run, "pickplace.training.train", config_name="train")
evaluate = partial(_run, "pickplace.evaluation.evaluate", config_name="evaluate")
plan = partial(_run, "pickplace.serve.json_lines", "pickplace.robot.planner")
physics = partial(_run, "pickplace.physics.command")
export = partial(_run, "pickplace.policies.export", "pickplace.policies.onnx_model")
serve = partial(_run, "pickplace.serve.serve", "pickplace.robot.planner")
