"""The ``pickplace-physics`` command: carry out the plans of a ``plans.jsonl``, one line of JSON for each episode."""

import argparse
import json
from dataclasses import asdict, fields

from pickplace.physics.plans import read_plans
from pickplace.physics.settle import Settle
from pickplace.runs.errors import one_sentence, write_output

#: Options that are given as numbers.
NUMBERS = tuple(item for item in fields(Settle) if item.name != "sleep")


def main() -> None:
    """Entry point of ``pickplace-physics``."""
    with one_sentence():
        arguments = vars(parser().parse_args())
        path = arguments.pop("plans")
        settle = Settle(sleep=not arguments.pop("no_sleep"), **arguments)
        for outcome in settle.carry_out(read_plans(path)):
            write_output(json.dumps(asdict(outcome)) + "\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = argparse.ArgumentParser(
        prog="pickplace-physics",
        description="Carry out plans in MuJoCo: each item appears 2 mm above its planned pose and comes to rest, one "
        "after the other. Prints a line of JSON for each episode: whether an item was lost, which one, and when.",
        epilog="The file's format, and what is simulated: docs/physics.md",
    )
    options.add_argument("plans", help="plans.jsonl: one placement a line, in metres")
    helps = {
        "cell_size": "side of a cell; m", "friction": "sliding friction", "density": "of the items; kg/m^3",
        "gap": "what an item is narrower than planned; m", "noise": "standard deviation of a placement's error; m",
        "max_shift": "an item that has moved further is lost; cells", "max_tilt": "or has tilted further; degrees",
        "seed": "of the errors of placement", "workers": "processes",
    }  # fmt: skip
    for item in NUMBERS:
        kind = int if isinstance(item.default, int) else float
        option = f"--{item.name.replace('_', '-')}"
        options.add_argument(option, type=kind, default=item.default, help=f"{helps[item.name]} (default %(default)s)")
    options.add_argument("--no-sleep", action="store_true", help="compute bodies at rest, too: slower")
    return options


if __name__ == "__main__":
    main()
