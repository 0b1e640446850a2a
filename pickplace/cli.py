"""Entry points of the commands; ``--help`` is answered without waiting for torch."""

import os
import sys

from pickplace.runs.hydra_app import command

# A thread that waits for others sleeps. If it spun, it would hold up those that share its core. OpenMP reads this when
# torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

#: Flags that Hydra answers by itself.
ANSWERED_BY_HYDRA = {"--help", "-h", "--hydra-help", "--version"}


def train() -> None:
    """Entry point of ``pickplace-train``, see :mod:`pickplace.training.train`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        command("train", None)
    else:
        from pickplace.training.train import main

        main()


def evaluate() -> None:
    """Entry point of ``pickplace-evaluate``, see :mod:`pickplace.evaluation.evaluate`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        command("evaluate", None)
    else:
        from pickplace.evaluation.evaluate import main

        main()


def plan() -> None:
    """Entry point of ``pickplace-plan``, see :mod:`pickplace.robot.json_lines`."""
    from pickplace.robot.json_lines import main

    main()
