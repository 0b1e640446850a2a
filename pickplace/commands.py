"""Entry points of the commands that Hydra runs; what Hydra answers by itself does not wait for torch to load."""

import sys

from pickplace import config

ANSWERED_BY_HYDRA = {"--help", "-h", "--hydra-help", "--version"}


def train() -> None:
    """``pickplace-train``, see :mod:`pickplace.train`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        config.command("train", None)
    else:
        from pickplace.train import main

        main()


def evaluate() -> None:
    """``pickplace-evaluate``, see :mod:`pickplace.evaluate`."""
    if ANSWERED_BY_HYDRA & set(sys.argv[1:]):
        config.command("evaluate", None)
    else:
        from pickplace.evaluate import main

        main()
