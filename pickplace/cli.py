"""Entry points of the commands that Hydra runs; what Hydra answers by itself does not wait for torch to load."""

import sys

from pickplace.runs.hydra_app import command

ANSWERED_BY_HYDRA = {"--help", "-h", "--hydra-help", "--version"}


def train() -> None:
    """``pickplace-train``, see :mod:`pickplace.training.train`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        command("train", None)
    else:
        from pickplace.training.train import main

        main()


def evaluate() -> None:
    """``pickplace-evaluate``, see :mod:`pickplace.evaluation.evaluate`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        command("evaluate", None)
    else:
        from pickplace.evaluation.evaluate import main

        main()
