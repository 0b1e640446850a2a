"""The options of planning, shared by ``pickplace-plan`` and ``pickplace-serve``, and the planner that they name."""

import argparse
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from pickplace.common.files import read_text
from pickplace.common.validate import check_bytes, first_line, number, refuse_if, reword_errors, whole_number
from pickplace.robot.box import DepthMapError
from pickplace.serve.deadline import Deadline
from pickplace.serve.request import DEADLINE, MAX_DEADLINE, PLAN_OPTIONS, PlanRequest

if TYPE_CHECKING:
    from pickplace.robot.planner import Planner

MAX_PART = 2**24  # greatest size of a file with a part of the cell, in bytes
#: Parts of the cell that the command line may choose: key, meaning, example.
PARTS = (
    ("gripper", "the end effector", "cup_round"),
    ("support", "the rule for stability", "bearing"),
    ("reach", "the robot's reach", "annulus"),
)


def planner_options() -> dict[str, dict[str, Any]]:
    """Return the options of planning, which :func:`load_planner` reads, for :class:`Parser`."""
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
            "metavar": "NAME",
            "help": "what decides, such as joint_dbl or beam, or a file with its settings like those of conf/planner; "
            "default: the policy",
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
        **{
            f"--{part}": {
                "metavar": "NAME",
                "help": f"{what}: an option of conf/{part}, such as {example}, or a file like those there; default: as "
                "trained",
            }
            for part, what, example in PARTS
        },
        "--trust": {
            "action": "append", "metavar": "MODULE", "default": [],
            "help": "your own module whose classes the checkpoint's config may name; may be repeated",
        },
        "--threads": {"type": int, "metavar": "N", "help": "CPU threads; default: as many as it may use"},
        "--device": {"default": "cpu", "help": "cpu (the default) or cuda"},
    }  # fmt: skip


def load_planner(args: argparse.Namespace, cell: dict | None = None) -> tuple["Planner", dict]:
    """Return the planner that a command line names, and the default settings of requests.

    Args:
        args: the command line.
        cell: settings of the cell, which replace the command line's.

    Raises:
        ValueError: for arguments or a checkpoint that cannot be used.
    """
    from pickplace.common.machine import use_threads
    from pickplace.config.allowlist import own_modules, refuse_foreign_targets
    from pickplace.robot.planner import MAX_ALTERNATIVES, Planner  # here, so that --help does not wait for torch
    from pickplace.rules.cell import CellSpec

    use_threads("--threads", args.threads)
    keys = ("bin_size", "tote_size", "effector_size", "rotations")
    sizes = {key: value for key in keys if (value := getattr(args, key)) is not None}
    sizes |= {part: read_part(part, value) for part, *_ in PARTS if (value := getattr(args, part)) is not None}
    refuse_if(
        args.gripper is not None and args.effector_size is not None,
        f"--gripper={args.gripper} --effector-size: got both; expected one of them, as a gripper has a size.",
    )
    sizes = sizes if cell is None else cell
    candidates = int(args.candidates) if args.candidates.isdecimal() else args.candidates
    decides = read_planner(args.planner)
    refuse_foreign_targets({"planner": decides}, own_modules(args.trust))
    if args.checkpoint is not None:
        planner = Planner.load(args.checkpoint, candidates, args.device, args.trust, decides, **sizes)
    else:
        refuse_if(
            args.planner is None, "checkpoint: missing; expected a checkpoint, or --planner joint_dbl or the like."
        )
        refuse_if(
            candidates != "all",
            f"--candidates={args.candidates}: only a policy has candidates; expected a checkpoint.",
        )
        planner = Planner(CellSpec(**sizes), planner=decides)
    defaults = {key.name: getattr(args, key.name) for key in PLAN_OPTIONS}
    PlanRequest(**defaults).scene()  # refuse bad settings now, not in the answer to each request
    whole_number("--alternatives", args.alternatives, 0, MAX_ALTERNATIVES)
    number("--deadline", args.deadline, 0.001, MAX_DEADLINE, "seconds")
    check_bytes("--planner", 0)  # refuse a bad limit on the memory now
    return planner, defaults


def plan_once(planner: "Planner") -> None:
    """Plan once for an item in an empty tote: the first request then takes no longer, and a faulty policy fails early.

    Raises:
        FloatingPointError: for a policy whose scores are not finite.
    """
    from pickplace.robot.scene import Scene  # here, so that --help does not wait for torch

    (wide, deep, _), sides = planner.cell.bin_size, planner.cell.tote_size
    w, d, h = (1, 1, 1) if planner.training is None else min(planner.training.kinds)
    bin_depth, x, y = np.zeros((wide, deep), dtype=np.int64), (wide - w) // 2, (deep - d) // 2
    bin_depth[x : x + w, y : y + d] = h
    with suppress(DepthMapError, TimeoutError):  # the planner may not serve such an item, or be slow
        scene = Scene.from_maps(bin_depth, np.full(sides[:2], sides[2]))
        Deadline(DEADLINE).run(lambda: planner.plan(scene, alternatives=1))


def read_planner(name: str | Mapping[str, Any] | None) -> str | Mapping[str, Any] | None:
    """Return a planner's settings from a ``.yaml`` file like those in ``conf/planner``; return a short name as it is.

    Raises:
        ValueError: for a file that cannot be read, or holds no settings.
    """
    if not isinstance(name, str) or not name.endswith((".yaml", ".yml")):
        return name
    expected = "expected settings with the key _target_, such as conf/planner/beam.yaml."
    content = _read_yaml("planner", name, name, expected)
    refuse_if(not isinstance(content, dict) or "_target_" not in content, f"--planner={name}: {expected}")
    return content


def read_part(key: str, name: str):
    """Return a part of the cell from an option of ``conf/``, or from a file like those there.

    Args:
        key: ``gripper``, ``support`` or ``reach``.
        name: of the option, or a path.

    Raises:
        ValueError: naming the file, or the key in it.
    """
    from pickplace.config.registry import build
    from pickplace.config.words import conf_dir

    options = {path.stem: path for path in sorted((conf_dir() / key).glob("*.yaml"))}
    expected = f"expected {', '.join(options)}, or a file with the key {key}, such as conf/{key}/{[*options][0]}.yaml."
    content = _read_yaml(key, name, options.get(name, name), expected)
    refuse_if(not isinstance(content, dict) or [*content] != [key], f"--{key}={name}: {expected}")
    return build("env", content)[key]


def _read_yaml(option: str, name: str, path, expected: str) -> Any:
    """Return the content of the file at ``path``, the value ``name`` of an option; ``expected`` ends its errors."""
    from yaml import YAMLError, safe_load  # here, so that --help is fast

    with reword_errors(
        (OSError, ValueError, YAMLError),
        lambda error: ValueError(f"--{option}={name}: {first_line(error)}; {expected}"),
    ):
        return safe_load(read_text(path, MAX_PART))
