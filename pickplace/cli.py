"""Entry points of the commands. A command line is read and checked before torch is imported."""

import logging
import os
import signal
import sys
from functools import partial

from pickplace.common.interrupts import end_process, import_quietly, set_interrupt_handler

# Let waiting threads sleep: a spinning thread would slow down others on its core. OpenMP reads this when torch is
# loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def _run(module: str) -> None:
    """Import the module of a command, and run its ``main``. Once that has ended, Ctrl-C ends the process quietly."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed: the next file that is opened would get its number
            os.open(os.devnull, os.O_RDWR)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115  open until the end
    logging.raiseExceptions = False  # else each line prints a traceback on a closed terminal or a full disk
    command = import_quietly(module)
    set_interrupt_handler(signal.default_int_handler)
    try:
        command.main()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        set_interrupt_handler(end_process)


# Entry points of pickplace-train and so on.
train = partial(_run, "pickplace.training.command")
evaluate = partial(_run, "pickplace.evaluation.command")
plan = partial(_run, "pickplace.serve.json_lines")
physics = partial(_run, "pickplace.physics.command")
export = partial(_run, "pickplace.policies.export")
serve = partial(_run, "pickplace.serve.serve")
pack = partial(_run, "pickplace.evaluation.pack_command")
