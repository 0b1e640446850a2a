"""The ``pickplace-plan`` command: one plan from two ``.npy`` files, or a process that answers JSON lines."""

import argparse
import io
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from pickplace.common.files import read_file, read_text
from pickplace.common.validate import whole_number
from pickplace.config.errors import Parser, one_sentence, write_output
from pickplace.robot.box import DepthMapError
from pickplace.serve.request import MAX_REQUEST, PLAN_OPTIONS, PlanRequest, answer

if TYPE_CHECKING:
    from pickplace.robot.planner import Planner

MAX_MAP = 2**26  # greatest size of a .npy file, in bytes


def main() -> None:
    """Entry point of ``pickplace-plan``."""
    with one_sentence():
        run(parser().parse_args())


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = Parser(
        prog="pickplace-plan",
        description="Plan one pick and one place. With --bin and --tote: one plan, as JSON. Without them: read one "
        'request a line from standard input, {"bin_depth": [[...]], "tote_depth": [[...]]}, and answer each with a '
        'plan in one line; "items": [{"x": .., "y": .., "w": .., "d": .., "h": .., "yaw": ..}, ...] may stand '
        "for bin_depth. A bad request is answered with an error, and the process goes on.",
        epilog="Maps, frames of reference and errors: docs/robot.md",
    )
    add = options.add_argument
    add("--bin", metavar="NPY", help="depth map [W_B, D_B] or finer: height above the bin's floor")
    add("--bin-labels", metavar="NPY", help="map in the shape of --bin: a number for each of several items, else 0")
    add("--tote", metavar="NPY", help="depth map [W_T, D_T] or finer: remaining height, from surface to rim")
    add("--tote-bearing", metavar="NPY", help="map [W_T, D_T]: tote_bearing of the plan before; default: all 1")
    add("--time", action="store_true", help="print the latency of each plan on standard error")
    add_planner_options(options)
    return options


def add_planner_options(options: argparse.ArgumentParser) -> None:
    """Add what says how to plan, which :func:`load_planner` reads."""
    add = options.add_argument
    add("checkpoint", nargs="?", help="a run folder, a checkpoint, or pretrained/<name>")
    add("--planner", metavar="NAME", help="what decides, such as joint_dbl or lookahead; default: the policy")
    for key in PLAN_OPTIONS:
        text = key.metadata["description"] + (" (default %(default)s)" if key.default is not None else "")
        add(f"--{key.name.replace('_', '-')}", type=key.metadata["option"], metavar="N", default=key.default, help=text)
    add("--candidates", metavar="K", default="all", help="number of most probable actions tried, or all (the default)")
    add("--bin-size", type=int, nargs=3, metavar=("W", "D", "H"), help="cells; default: as trained")
    add("--tote-size", type=int, nargs=3, metavar=("W", "D", "H"), help="cells; default: as trained")
    add("--effector-size", type=int, nargs=2, metavar=("W", "D"), help="cells; default: as trained")
    add("--rotations", type=int, metavar="R", help="quarter turns to choose from; default: as trained")
    add("--reach", metavar="YAML", help="file such as conf/reach/annulus.yaml, the robot's reach; default: as trained")
    add(
        "--trust", action="append", metavar="MODULE", default=[],
        help="your own module whose classes the checkpoint's config may name; may be repeated",
    )  # fmt: skip
    add("--threads", type=int, metavar="N", help="CPU threads; default: as many as it may use")
    add("--device", default="cpu", help="cpu (the default) or cuda")


def load_planner(args: argparse.Namespace) -> tuple["Planner", dict]:
    """Return the planner that a command line names, and the settings of its requests unless they say otherwise.

    Raises:
        ValueError: for arguments or a checkpoint that cannot be used.
    """
    from pickplace.common.machine import use_threads
    from pickplace.robot.planner import MAX_ALTERNATIVES, Planner  # here, so that --help need not wait for torch
    from pickplace.rules.cell import CellSpec

    use_threads("--threads", args.threads)
    sizes = {key: getattr(args, key) for key in ("bin_size", "tote_size", "effector_size", "rotations")}
    sizes = {key: value for key, value in sizes.items() if value is not None}
    if args.reach is not None:
        sizes["reach"] = read_reach(args.reach)
    candidates = int(args.candidates) if args.candidates.isdecimal() else args.candidates
    if args.checkpoint is not None:
        options = {"candidates": candidates, "device": args.device, "trust": args.trust, "planner": args.planner}
        planner = Planner.load(args.checkpoint, **options, **sizes)
    elif args.planner is not None:
        if candidates != "all":
            raise ValueError(f"--candidates={args.candidates}: only a policy has candidates; expected a checkpoint.")
        planner = Planner(CellSpec(**sizes), planner=args.planner)
    else:
        raise ValueError("checkpoint: missing; expected a checkpoint, or --planner joint_dbl or the like.")
    defaults = {key.name: getattr(args, key.name) for key in PLAN_OPTIONS}
    PlanRequest(**defaults).scene()  # refuses settings now, not in the answer to each request
    whole_number("--alternatives", args.alternatives, 0, MAX_ALTERNATIVES)
    return planner, defaults


def run(args: argparse.Namespace) -> None:
    """Load the planner, then plan once, or once for each line of standard input.

    Raises:
        ValueError: for arguments, a checkpoint or maps that cannot be used.
    """
    if (args.bin is None) != (args.tote is None):
        missing = "--bin" if args.bin is None else "--tote"
        raise ValueError(f"{missing}: no file; expected both --bin and --tote, or neither to read JSON lines.")
    for option, path in (("--bin-labels", args.bin_labels), ("--tote-bearing", args.tote_bearing)):
        if path is not None and args.tote is None:
            raise ValueError(f"{option}={path}: expected --bin and --tote, too.")
    if sys.stdout is None or (sys.stdin is None and args.bin is None):
        raise ValueError("standard input or output is closed; expected requests and a place for the plans.")
    planner, defaults = load_planner(args)
    if args.bin is not None:
        files = {"bin_depth": args.bin, "bin_labels": args.bin_labels, "tote_depth": args.tote}
        files["tote_bearing"] = args.tote_bearing
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
        sys.stderr.write(f"planned in {(time.perf_counter() - start) * 1e3:.1f} ms\n")
        sys.stderr.flush()


def read_reach(path: str):
    """Return the reach that a file such as those of ``conf/reach`` describes; None: the robot reaches everything.

    Raises:
        ValueError: naming the file, or the key in it.
    """
    from yaml import YAMLError, safe_load

    from pickplace.config.registry import build

    expected = "expected a file with the key reach, such as conf/reach/annulus.yaml."
    try:
        content = safe_load(read_text(path, MAX_REQUEST))
    except (OSError, ValueError, YAMLError) as error:
        raise ValueError(f"--reach={path}: {str(error).splitlines()[0]}; {expected}") from error
    if not isinstance(content, dict) or [*content] != ["reach"]:
        raise ValueError(f"--reach={path}: {expected}")
    return build("env", content)["reach"]


def read_map(path: str) -> np.ndarray:
    """Return a depth map from a ``.npy`` file; nothing in it is unpickled.

    Raises:
        ValueError: naming the file.
    """
    try:
        content = read_file(path, MAX_MAP, empty=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error}).") from error
    try:
        values = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # of any type: numpy evaluates the header
        raise ValueError(f"{path}: cannot be read; expected a .npy file with one array of numbers.") from error
    if not isinstance(values, np.ndarray):
        raise ValueError(f"{path}: expected a .npy file with one array, got an archive.")
    return values
