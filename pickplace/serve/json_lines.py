"""The ``pickplace-plan`` command: one plan from two ``.npy`` files, or a process that answers JSON lines."""

import argparse
import io
import json
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from pickplace.common.files import read_file, read_text
from pickplace.config.errors import one_sentence, sentence, write_output

if TYPE_CHECKING:
    from pickplace.robot.planner import Planner

MAX_LINE = 2**24  # greatest length of a request, in bytes
MAX_MAP = 2**26  # greatest size of a .npy file, in bytes

#: Keys of a request; ``id`` comes back as it is.
SETTINGS = ("tote_height", "cell_size", "accuracy", "clearance", "alternatives")
REQUEST_KEYS = ("id", "bin_depth", "bin_labels", "items", "tote_depth", "tote_bearing", *SETTINGS)


def main() -> None:
    """Entry point of ``pickplace-plan``."""
    with one_sentence():
        run(parser().parse_args())


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    options = argparse.ArgumentParser(
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
    add("--tote-height", type=float, metavar="H", help="height of the tote's rim; default: that of --tote-size")
    add("--cell-size", type=float, metavar="M", help="side of a cell in metres, if the maps are in metres")
    for key, default, what in (
        ("accuracy", 0.003, "greatest error of a measured height, in metres"),
        ("clearance", 0.005, "least distance of an item from what stands beside it, in metres"),
    ):
        add(f"--{key}", type=float, metavar="M", default=default, help=f"{what} (default %(default)s)")
    add("--candidates", metavar="K", default="all", help="number of most probable actions tried, or all (the default)")
    add(
        "--alternatives", type=int, metavar="N", default=10,
        help="number of most probable choices reported (default %(default)s)",
    )  # fmt: skip
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
    from pickplace.robot.planner import Planner  # here, so that --help need not wait for torch
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
    defaults = {key: getattr(args, key) for key in SETTINGS}
    planner.check_settings(**defaults)  # now, not in the answer to each request
    return planner, defaults


def run(args: argparse.Namespace) -> None:
    """Load the planner, then plan once, or once for each line of standard input.

    Raises:
        ValueError: for arguments, a checkpoint or maps that cannot be used.
    """
    from pickplace.robot.measure import DepthMapError

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
            result = plan_as_dict(planner, args.time, **maps, **defaults)
        except DepthMapError as error:
            file = next((path for key, path in files.items() if str(error).startswith(key)), args.bin)
            raise DepthMapError(f"{file}: {error}") from error
        write_output(json.dumps(result, indent=1) + "\n")
        return
    for line in read_lines(sys.stdin.buffer):
        if line.strip() or len(line) > MAX_LINE:
            write_output(json.dumps(answer(planner, line, defaults, args.time)) + "\n")


def read_lines(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of a stream; of a line longer than :data:`MAX_LINE` only the first bytes, at once."""
    while line := stream.readline(MAX_LINE + 1):
        yield line
        while len(line) > MAX_LINE and not line.endswith(b"\n"):
            line = stream.readline(MAX_LINE + 1)


def plan_as_dict(planner: "Planner", print_latency: bool, **request) -> dict:
    """Return a plan as plain values; its latency is printed on standard error if asked for."""
    start = time.perf_counter()
    plan = planner.plan(**request).as_dict()
    if print_latency:
        sys.stderr.write(f"planned in {(time.perf_counter() - start) * 1e3:.1f} ms\n")
        sys.stderr.flush()
    return plan


def answer(planner: "Planner", line: bytes, defaults: dict, print_latency: bool = False) -> dict:
    """Return the reply to one line: a plan, or ``{"error": ...}`` in one sentence; with the request's ``id``."""
    try:
        return answer_request(planner, parse_request(line), defaults, print_latency)
    except ValueError as error:
        return {"error": sentence(error)}


def parse_request(text: bytes) -> dict:
    """Return the object that a request's text holds, whatever its keys.

    Raises:
        ValueError: for a text that is too long, or is no object in JSON.
    """
    if len(text) > MAX_LINE:
        raise ValueError(f"the request has more than {MAX_LINE:,} bytes; expected a shorter one.")
    try:
        request = json.loads(text.decode(), parse_constant=refuse_constant, parse_float=finite_float)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"the request is not JSON: {error}.") from error
    if not isinstance(request, dict):
        raise ValueError(f"got {type(request).__name__}, expected an object with bin_depth and tote_depth.")
    return request


def answer_request(planner: "Planner", request: dict, defaults: dict, print_latency: bool = False) -> dict:
    """Return the reply to a request that was parsed, as :func:`answer` does."""
    reply = {key: request[key] for key in request if key == "id"}
    request = {key: request[key] for key in request if key != "id"}
    try:
        if unknown := sorted(set(request) - set(REQUEST_KEYS)):
            raise ValueError(f"{unknown[0][:40]}: there is no such key; expected any of {', '.join(REQUEST_KEYS)}.")
        for key in ("tote_depth",) if "items" in request else ("bin_depth", "tote_depth"):
            if key not in request:
                raise ValueError(f"{key}: missing; expected a depth map as a list of rows.")
        if "items" in request:
            request["items"] = read_boxes(request["items"])
        return {**reply, **plan_as_dict(planner, print_latency, **{**defaults, **request})}
    except ValueError as error:
        return {**reply, "error": sentence(error)}


def read_boxes(items) -> list:
    """Return the boxes of a request's ``items``.

    Raises:
        ValueError: naming the first one with other keys.
    """
    from pickplace.robot.measure import Box

    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError("items: expected a list of objects with x, y, w, d, h and, if it is turned, yaw.")
    boxes = []
    for number, item in enumerate(items):
        try:
            boxes.append(Box(**item))
        except TypeError as error:
            expected = "expected the keys x, y, w, d, h and, if it is turned, yaw."
            raise ValueError(f"items[{number}]: {expected}") from error
    return boxes


def finite_float(text: str) -> float:
    """Return a number of a JSON text; refuse 1e999, which Python reads as infinity and would write as such."""
    number = float(text)
    return number if abs(number) < float("inf") else refuse_constant(text)


def refuse_constant(name: str):
    """Refuse NaN and Infinity, which Python's parser takes and JSON does not have."""
    raise ValueError(f"the request is not JSON: got {name[:20]}, expected a finite number.")


def read_reach(path: str):
    """Return the reach that a file such as those of ``conf/reach`` describes; None: the robot reaches everything.

    Raises:
        ValueError: naming the file, or the key in it.
    """
    from yaml import YAMLError, safe_load

    from pickplace.config.registry import build

    expected = "expected a file with the key reach, such as conf/reach/annulus.yaml."
    try:
        content = safe_load(read_text(path, MAX_LINE))
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


if __name__ == "__main__":
    main()
