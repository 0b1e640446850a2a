"""The ``pickplace-plan`` command: one plan from two ``.npy`` files, or a process that answers JSON lines."""

import argparse
import io
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.files import read_file
from pickplace.common.interrupts import import_quietly
from pickplace.common.validate import refuse_if, reword_errors
from pickplace.robot.box import DepthMapError
from pickplace.runs.locate import read_facts
from pickplace.serve.deadline import Deadline
from pickplace.serve.decisions import replay
from pickplace.serve.options import PARTS, load_planner, plan_once, planner_options
from pickplace.serve.request import PlanRequest, RequestLimits, answer, to_json

if TYPE_CHECKING:
    from pickplace.robot.planner import Planner

MAX_MAP = 2**26  # greatest size of a .npy file, in bytes


@one_sentence()
def main() -> None:
    """Entry point of ``pickplace-plan``."""
    options = parser().parse_args()
    import_quietly("pickplace.robot.planner")
    run(options)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return Parser(
        prog="pickplace-plan",
        description="Plan one pick and one place. With --bin and --tote: one plan, as JSON. Without them: read one "
        'request a line from standard input, {"bin_depth": [[...]], "tote_depth": [[...]]}, and answer each with a '
        'plan in one line; "items": [{"x": .., "y": .., "w": .., "d": .., "h": .., "yaw": ..}, ...] may stand '
        "for bin_depth. A bad request is answered with an error, and the process goes on.",
        epilog="Requests and answers: docs/service.md; maps and frames of reference: docs/robot.md",
        options={
            "--bin": {"metavar": "NPY", "help": "depth map [W_B, D_B] or finer: height above the bin's floor"},
            "--bin-labels": {
                "metavar": "NPY", "help": "map in the shape of --bin: a number for each of several items, else 0",
            },
            "--tote": {
                "metavar": "NPY", "help": "depth map [W_T, D_T] or finer: remaining height, from surface to rim",
            },
            "--tote-bearing": {
                "metavar": "NPY", "help": "map [W_T, D_T]: tote_bearing of the plan before; default: all 1",
            },
            "--replay": {
                "metavar": "LOG", "help": "plan all requests of a log of pickplace-serve again, with the planner that "
                "it names, and say which plans differ; exit code 1 if any does",
            },
            "--time": {"action": "store_true", "help": "print the latency of each plan on standard error"},
            **planner_options(),
        },
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Load the planner, then plan once, or once for each line of standard input.

    Raises:
        ValueError: for arguments, a checkpoint or maps that cannot be used.
    """
    refuse_if(
        (args.bin is None) != (args.tote is None),
        f"--{'bin' if args.bin is None else 'tote'}: no file; expected both --bin and --tote, or neither to read JSON "
        "lines.",
    )
    for option, path in (("--bin-labels", args.bin_labels), ("--tote-bearing", args.tote_bearing)):
        refuse_if(path is not None and args.tote is None, f"{option}={path}: expected --bin and --tote, too.")
    refuse_if(
        sys.stdout is None or (sys.stdin is None and args.bin is None),
        "standard input or output is closed; expected requests and a place for the plans.",
    )
    if args.replay is not None:
        replay_log(args)
        return
    planner, defaults = load_planner(args)
    if args.bin is not None:
        files = {
            "bin_depth": args.bin, "bin_labels": args.bin_labels, "tote_depth": args.tote,
            "tote_bearing": args.tote_bearing,
        }  # fmt: skip
        maps = {key: read_map(path) for key, path in files.items() if path is not None}
        try:
            with latency(args.time):
                request = PlanRequest.parse(maps, defaults)
                result = Deadline(request.deadline).run(lambda: request.plan(planner)).as_dict()
        except DepthMapError as error:
            file = next((path for key, path in files.items() if str(error).startswith(key)), args.bin)
            raise DepthMapError(f"{file}: {error}") from error
        write_output(to_json(result, indent=1) + "\n")
        return
    plan_once(planner)
    most = RequestLimits.of(planner.cell).size
    for line in read_lines(sys.stdin.buffer, most):
        if line.strip() or len(line) > most:
            with latency(args.time):
                text = answer(planner, line, defaults).text
            write_output(text + "\n")


def replay_log(args: argparse.Namespace) -> None:
    """Plan the requests of a decision log again, and write the number of equal plans and the ones that differ.

    Raises:
        ValueError: see :func:`~pickplace.serve.decisions.replay`.
        SystemExit: with the code 1, if a plan differs.
    """
    given = [args.checkpoint, args.planner, args.bin, args.tote, *(getattr(args, part) for part, *_ in PARTS)]
    refuse_if(
        any(each is not None for each in given),
        f"--replay={args.replay}: the log names checkpoint, planner and cell; expected no other.",
    )

    def make(start: dict) -> "Planner":
        from pickplace.policies.restore import build_cell
        from pickplace.rules.cell import CELL_SETTINGS
        from pickplace.runs.provenance import versions

        if (changed := versions()) != start["versions"]:
            old = {key: value for key, value in start["versions"].items() if changed.get(key) != value}
            sys.stderr.write(f"the log was written with other versions: {old}\n")
        if start["checkpoint"] is not None:
            found = read_facts(start["checkpoint"])
            refuse_if(
                found.get("sha256") != start["sha256"],
                f"checkpoint={start['checkpoint']}: other weights than those of the log; expected those.",
            )
        cell = build_cell(start["cell"])
        again = argparse.Namespace(
            **{**vars(args), **{key: start[key] for key in ("checkpoint", "planner", "candidates")}}
        )
        return load_planner(again, {key: getattr(cell, key) for key in CELL_SETTINGS})[0]

    same, differing = replay(args.replay, make)
    write_output("".join(f"{line}\n" for line in differing) + f"{same} of {same + len(differing)} plans are the same\n")
    if differing:
        sys.exit(1)


def read_lines(stream: BinaryIO, most: int) -> Iterator[bytes]:
    """Yield the lines of a stream. A line longer than ``most`` bytes is cut, and yielded before its end is read."""
    while line := stream.readline(most + 1):
        yield line
        while len(line) > most and not line.endswith(b"\n"):
            line = stream.readline(most + 1)


@contextmanager
def latency(is_printed: bool) -> Iterator[None]:
    """Print the time that the block takes on standard error, if ``is_printed``."""
    start = time.perf_counter()
    yield
    if is_printed:
        sys.stderr.write(f"planned in {(time.perf_counter() - start) * 1e3:.1f} ms\n")  # each line is written at once


def read_map(path: str) -> np.ndarray:
    """Return a depth map from a ``.npy`` file; nothing in it is unpickled.

    Raises:
        ValueError: naming the file.
        OSError: if the file is missing or cannot be read.
    """
    content = read_file(path, MAX_MAP, empty=False)
    with reword_errors(
        Exception,  # any type, as numpy evaluates the header
        lambda _: ValueError(f"{path}: cannot be read; expected a .npy file with one array of numbers."),
    ):
        values = np.load(io.BytesIO(content), allow_pickle=False)
    refuse_if(not isinstance(values, np.ndarray), f"{path}: expected a .npy file with one array, got an archive.")
    return values
