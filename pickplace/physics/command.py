"""The ``pickplace-physics`` command: carry out the plans of a ``plans.jsonl``, one line of JSON for each episode."""

import argparse
import json

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.validate import refuse_if


def main() -> None:
    """Entry point of ``pickplace-physics``."""
    with one_sentence():
        arguments = parser().parse_intermixed_args()
        from omegaconf import OmegaConf  # here, so that --help does not wait for it
        from yaml import YAMLError

        from pickplace.physics.engine import build_engine
        from pickplace.physics.plans import read_plans

        settings = OmegaConf.create({"_target_": arguments.method})
        for word in arguments.settings:
            key, equals, _ = word.partition("=")
            try:
                refuse_if(not equals or not key.isidentifier() or key == "_target_", key)
                settings.merge_with_dotlist([word])
            except (YAMLError, ValueError) as error:
                raise ValueError(f"{word}: expected <key>=<value>, such as friction=0.3.") from error
        plans = read_plans(arguments.plans)
        refuse_if(not plans, f"{arguments.plans}: no placement in it; expected a line for each.")
        for outcome in build_engine(settings).carry_out(plans):
            write_output(json.dumps(outcome.facts()) + "\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return Parser(
        prog="pickplace-physics",
        description="Carry out plans in MuJoCo. Prints a line of JSON for each episode: whether an item was lost, "
        "which one, during which placement, and what was placed before.",
        epilog="The file's format, the settings, and what is simulated: docs/physics.md",
        options={
            "plans": {"help": "plans.jsonl: one placement a line, in metres"},
            "settings": {
                "nargs": "*", "metavar": "KEY=VALUE", "help": "settings, such as friction=0.3 workers=2",
            },
            "--method": {
                "metavar": "NAME", "default": "settle",
                "help": "settle: items appear at their places; execute: a gantry brings them from the bin; or the "
                "dotted path of a class of your own (default %(default)s)",
            },
        },
    )  # fmt: skip
