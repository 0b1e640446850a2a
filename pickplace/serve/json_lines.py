"""The ``pickplace-plan`` command: one plan from two ``.npy`` files, or a process that answers JSON lines."""

import argparse
import io
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.files import read_file, read_text
from pickplace.common.interrupts import import_quietly
from pickplace.common.validate import first_line, refuse_if, reworded, whole_number
from pickplace.robot.box import DepthMapError
from pickplace.serve.request import MAX_REQUEST, PLAN_OPTIONS, PlanRequest, answer

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
        epilog="Maps, frames of reference and errors: docs/robot.md",
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
            "--time": {"action": "store_true", "help": "print the latency of each plan on standard error"},
            **planner_options(),
        },
    )  # fmt: skip


def planner_options() -> dict[str, dict[str, Any]]:
    """Return the options that say how to plan, which :func:`load_planner` reads; see :class:`Parser`."""
    of_requests = {
        f"--{key.name.replace('_', '-')}": {
            "type": key.metadata["option"], "metavar": "N", "default": key.default,
            "help": key.metadata["description"] + (" (default %(default)s)" if key.default is not None else ""),
        }
        for key in PLAN_OPTIONS
    }  # fmt: skip
    return {
        "checkpoint": {"nargs": "?", "help": "a run folder, a checkpoint, or pretrained/<name>"},
        "--planner": {
            "metavar": "NAME", "help": "what decides, such as joint_dbl or lookahead; default: the policy",
        },
        **of_requests,
        "--candidates": {
            "metavar": "K", "default": "all", "help": "number of most probable actions tried, or all (the default)",
        },
        "--bin-size": {"type": int, "nargs": 3, "metavar": ("W", "D", "H"), "help": "cells; default: as trained"},
        "--tote-size": {"type": int, "nargs": 3, "metavar": ("W", "D", "H"), "help": "cells; default: as trained"},
        "--effector-size": {"type": int, "nargs": 2, "metavar": ("W", "D"), "help": "cells; default: as trained"},
        "--rotations": {
            "type": int, "metavar": "R", "help": "quarter turns to choose from; default: as trained",
        },
        "--reach": {
            "metavar": "YAML",
            "help": "file such as conf/reach/annulus.yaml, the robot's reach; default: as trained",
        },
        "--trust": {
            "action": "append", "metavar": "MODULE", "default": [],
            "help": "your own module whose classes the checkpoint's config may name; may be repeated",
        },
        "--threads": {"type": int, "metavar": "N", "help": "CPU threads; default: as many as it may use"},
        "--device": {"default": "cpu", "help": "cpu (the default) or cuda"},
    }  # fmt: skip


def load_planner(args: argparse.Namespace) -> tuple["Planner", dict]:
    """Return the planner that a command line names, and the settings of its requests unless they say otherwise.

    Raises:
        ValueError: for arguments or a checkpoint that cannot be used.
    """
    from pickplace.common.machine import use_threads
    from pickplace.robot.planner import MAX_ALTERNATIVES, Planner  # here, so that --help need not wait for torch
    from pickplace.rules.cell import CellSpec

    use_threads("--threads", args.threads)
    keys = ("bin_size", "tote_size", "effector_size", "rotations")
    sizes = {key: value for key in keys if (value := getattr(args, key)) is not None}
    if args.reach is not None:
        sizes["reach"] = read_reach(args.reach)
    candidates = int(args.candidates) if args.candidates.isdecimal() else args.candidates
    if args.checkpoint is not None:
        planner = Planner.load(args.checkpoint, candidates, args.device, args.trust, args.planner, **sizes)
    else:
        refuse_if(
            args.planner is None, "checkpoint: missing; expected a checkpoint, or --planner joint_dbl or the like."
        )
        refuse_if(
            candidates != "all",
            f"--candidates={args.candidates}: only a policy has candidates; expected a checkpoint.",
        )
        planner = Planner(CellSpec(**sizes), planner=args.planner)
    defaults = {key.name: getattr(args, key.name) for key in PLAN_OPTIONS}
    PlanRequest(**defaults).scene()  # refuses settings now, not in the answer to each request
    whole_number("--alternatives", args.alternatives, 0, MAX_ALTERNATIVES)
    return planner, defaults


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
    planner, defaults = load_planner(args)
    if args.bin is not None:
        files = {
            "bin_depth": args.bin, "bin_labels": args.bin_labels, "tote_depth": args.tote,
            "tote_bearing": args.tote_bearing,
        }  # fmt: skip
        maps = {key: read_map(path) for key, path in files.items() if path is not None}
        try:
            with latency(args.time):
                result = PlanRequest.parse(maps, defaults).plan(planner).as_dict()
        except DepthMapError as error:
            file = next((path for key, path in files.items() if str(error).startswith(key)), args.bin)
            raise DepthMapError(f"{file}: {error}") from error
        write_output(json.dumps(result, indent=1) + "\n")
        return
    for line in read_lines(sys.stdin.buffer):
        if line.strip() or len(line) > MAX_REQUEST:
            with latency(args.time):
                _, reply, _ = answer(planner, line, defaults)
            write_output(json.dumps(reply) + "\n")


def read_lines(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of a stream; of a line longer than :data:`MAX_REQUEST` only the first bytes, at once."""
    while line := stream.readline(MAX_REQUEST + 1):
        yield line
        while len(line) > MAX_REQUEST and not line.endswith(b"\n"):
            line = stream.readline(MAX_REQUEST + 1)


@contextmanager
def latency(is_printed: bool) -> Iterator[None]:
    """Print the time that something takes on standard error, if asked for."""
    start = time.perf_counter()
    yield
    if is_printed:
        sys.stderr.write(f"planned in {(time.perf_counter() - start) * 1e3:.1f} ms\n")  # a line leaves at once


def read_reach(path: str):
    """Return the reach that a file such as those of ``conf/reach`` describes; None: the robot reaches everything.

    Raises:
        ValueError: naming the file, or the key in it.
    """
    from yaml import YAMLError, safe_load

    from pickplace.config.registry import build

    expected = "expected a file with the key reach, such as conf/reach/annulus.yaml."
    with reworded(
        (OSError, ValueError, YAMLError),
        lambda error: ValueError(f"--reach={path}: {first_line(error)}; {expected}"),
    ):
        content = safe_load(read_text(path, MAX_REQUEST))
    refuse_if(not isinstance(content, dict) or [*content] != ["reach"], f"--reach={path}: {expected}")
    return build("env", content)["reach"]


def read_map(path: str) -> np.ndarray:
    """Return a depth map from a ``.npy`` file; nothing in it is unpickled.

    Raises:
        ValueError: naming the file.
        OSError: if there is none, or it cannot be read.
    """
    content = read_file(path, MAX_MAP, empty=False)
    with reworded(
        Exception,  # of any type: numpy evaluates the header
        lambda _: ValueError(f"{path}: cannot be read; expected a .npy file with one array of numbers."),
    ):
        values = np.load(io.BytesIO(content), allow_pickle=False)
    refuse_if(not isinstance(values, np.ndarray), f"{path}: expected a .npy file with one array, got an archive.")
    return values
