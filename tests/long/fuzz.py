"""Send damaged requests to the robot's planner and to its JSON lines: python tests/long/fuzz.py [minutes] [seed]

Each line must get an answer of one line of strict JSON, with a plan or with an error of one sentence. Each pair of maps
in Python must give a plan or a ``DepthMapError``. Plans are checked by the rules. The first case that breaks this is
printed, and ends the run.
"""

import contextlib
import copy
import json
import random
import sys
import time
from collections import Counter

import numpy as np
import torch

from pickplace import CellSpec, Planner, State
from pickplace.policies.fcn_grasp import FootprintPolicy
from pickplace.robot.json_lines import answer
from pickplace.robot.planner import DepthMapError
from pickplace.task.feasibility import action_mask, footprint_mask, placing_maps
from pickplace.task.state import item_from_depth
from pickplace.task.transition import apply

DEFAULTS = {"tote_height": None, "cell_size": None, "tolerance": 0.25, "alternatives": 3}
KEYS = ("id", "bin_depth", "tote_depth", "tote_height", "cell_size", "tolerance", "alternatives", "more")
VALUES = [
    None, True, False, 0, -0.0, -1, 0.5, 1e-320, 5e-324, 1e308, -1e308, 2**31, 2**53 + 1, 2**63, 2**64, 10**400, "",
    "x", "6", "\ud800", "\u0000", [], {}, [[]], [[[]]], [[1, 2], [3]], {"a": 1}, 0.24999999999, 0.499999999, 0.05,
    1048576, 1048575,
]  # fmt: skip
#: Put into the text of a request in place of a digit; json.dumps would not write them.
TEXTS = [
    "NaN", "Infinity", "-Infinity", "1e999", "-1e999", "9" * 4299, "9" * 5000, "[" * 900, "[" * 200_000, "1.", "00",
    "{}",
]  # fmt: skip
DTYPES = (None, None, None, float, "f4", "f2", "i1", "u1", "u8", bool, complex, object, "U3", "M8[s]")


def good_request(draw: random.Random, cell: CellSpec) -> dict:
    """Return a request as a camera would send it."""
    (bin_w, bin_d, _), (tote_w, tote_d, rim) = cell.bin_size, cell.tote_size
    w, d, h = (draw.randint(1, 3) for _ in range(3))
    x, y = draw.randint(0, bin_w - w), draw.randint(0, bin_d - d)
    bin_depth = np.zeros((bin_w, bin_d), dtype=int)
    bin_depth[x : x + w, y : y + d] = h
    tote_depth = [[draw.randint(0, rim) for _ in range(tote_d)] for _ in range(tote_w)]
    return {"bin_depth": bin_depth.tolist(), "tote_depth": tote_depth}


def damage(draw: random.Random, request: dict) -> dict:
    """Replace, remove or change up to four parts of a request."""

    def value():
        return copy.deepcopy(draw.choice(VALUES))  # it may be damaged further

    for _ in range(draw.choice((0, 1, 1, 1, 2, 4))):
        key, kind = draw.choice(KEYS), draw.random()
        rows = request.get(key)
        if kind < 0.15:
            request.pop(key, None)
        elif kind < 0.5 or not isinstance(rows, list) or not rows:
            request[key] = value()
        elif kind < 0.6:
            request[key] = rows[:-1] if draw.random() < 0.5 else [*rows, rows[0]]
        elif isinstance(row := draw.choice(rows), list) and row:
            index = draw.randrange(len(row))
            changed = isinstance(row[index], int) and draw.random() < 0.5
            row[index] = row[index] + draw.choice((-1, 1, 0.2, 0.3)) if changed else value()
        else:
            rows[draw.randrange(len(rows))] = value()
    return request


def line_of(draw: random.Random, request: dict) -> bytes:
    """Return a request as a line, sometimes with wrong text, encoding or bytes."""
    text = json.dumps(request)
    if draw.random() < 0.2:
        index = draw.choice([index for index, letter in enumerate(text) if letter in "0123456789"] or [0])
        text = text[:index] + draw.choice(TEXTS) + text[index + 1 :]
    line = text.encode(draw.choice(("utf-8", "utf-8", "utf-8", "utf-16", "latin-1")))
    for _ in range(draw.choice((0, 0, 0, 1, 3))):
        index = draw.randrange(len(line) + 1)
        other = bytes([draw.randrange(256)]) + line[index + 1 :]
        shorter, repeated = line[index + draw.randint(1, 9) :], line[max(0, index - 20) :]
        line = line[:index] + draw.choice((other, shorter, b"", repeated))
    return line


def check_line(planner: Planner, line: bytes) -> str:
    """Answer a line, check the answer and return its status."""
    reply = answer(planner, line, DEFAULTS)
    text = json.dumps(reply, allow_nan=False)
    assert "\n" not in text and json.loads(text).keys() == reply.keys()
    if "error" in reply:
        assert set(reply) <= {"id", "error"} and reply["error"].strip() and "\n" not in reply["error"]
        assert len(reply["error"]) < 2000
        return "error"
    request = json.loads(line)
    unit = request.get("cell_size") or 1.0
    rim = round((request.get("tote_height") or planner.cell.tote_size[2] * unit) / unit)
    maps = (np.round(np.array(request[key], dtype=float) / unit).astype(int) for key in ("bin_depth", "tote_depth"))
    bin_depth, tote_depth = (torch.from_numpy(values)[None] for values in maps)
    item = item_from_depth(bin_depth.float())
    check_plan(planner.cell, State((rim - tote_depth).int(), torch.tensor([rim]), item), reply)
    return reply["status"]


def check_plan(cell: CellSpec, state: State, plan: dict) -> None:
    """Check a plan's status and effect by the rules."""
    feasible = action_mask(cell, placing_maps(cell, state))[0]
    if plan["status"] in ("ok", "rejected"):
        assert feasible.any()
    else:
        empty = state._replace(heights=torch.zeros_like(state.heights))
        fits_empty = footprint_mask(cell, placing_maps(cell, empty)).any()
        assert not feasible.any() and plan["status"] == ("stuck" if fits_empty else "impossible")
    if plan["status"] == "ok":
        assert feasible[plan["action"]]
        assert int(apply(cell, state, torch.tensor([plan["action"]])).failure) == 0
        gain = (plan["occupancy_after"] - plan["occupancy_before"]) * int(state.tote_height) * cell.num_places
        assert abs(gain - int(state.item.volume)) < 1e-6


def as_array(draw: random.Random, value):
    """Return the value as an array of some type, sometimes turned or with odd numbers; as it is if numpy refuses."""
    kind = draw.choice(DTYPES)
    with contextlib.suppress(ValueError, TypeError, OverflowError), np.errstate(all="ignore"):
        value = np.array(value, dtype=kind)
        if value.ndim and draw.random() < 0.3:
            value = draw.choice((value.T, value[None], value[..., ::-1]))
        if value.dtype.kind == "f" and value.size and draw.random() < 0.2:
            value.flat[draw.randrange(value.size)] = draw.choice((float("nan"), float("inf"), -0.0))
    return value


def check_arrays(planner: Planner, draw: random.Random, request: dict) -> str:
    """Plan from arrays and return the status."""
    maps = {key: as_array(draw, request.get(key)) for key in ("bin_depth", "tote_depth")}
    try:
        plan = planner.plan(**maps, **{key: request[key] for key in DEFAULTS if key in request})
    except DepthMapError as error:
        assert str(error) and "\n" not in str(error)
        return "error"
    json.dumps(plan.as_dict(), allow_nan=False)
    return plan.status


def fuzz(minutes: float, seed: int) -> Counter:
    """Send requests to planners of several sizes for some minutes; return how often each status came back."""
    draw, end, counts = random.Random(seed), time.monotonic() + 60 * minutes, Counter()
    torch.manual_seed(seed)
    others = ((4, 6, 2), (5, 7, 6), (2, 3), 2), ((3, 3, 1), (4, 4, 3), (1, 1), 1, "overlap")
    cells = [CellSpec(), *(CellSpec(*sizes) for sizes in others)]
    policies = [FootprintPolicy(cell, filters=8, hidden=8).eval() for cell in cells]
    planners = [Planner(policy.cell, policy, candidates) for policy in policies for candidates in ("all", 5)]
    while time.monotonic() < end:
        planner, line = draw.choice(planners), b""
        request = damage(draw, good_request(draw, planner.cell))
        try:
            if draw.random() < 0.7:
                line = line_of(draw, request)
                counts[check_line(planner, line)] += 1
            else:
                counts[check_arrays(planner, draw, request)] += 1
        except Exception:
            case = f"case {counts.total()} of seed {seed}, {planner.cell.describe()}"
            sys.stderr.write(f"{case}: {str(request)[:1500]}\n{line[:1500]}\n")
            raise
    return counts


if __name__ == "__main__":
    torch.set_num_threads(1)
    given = sys.argv[1:]
    minutes, seed = given + ["60", "0"][len(given) :]
    counts = fuzz(float(minutes), int(seed))
    statuses = ", ".join(f"{count:,} {status}" for status, count in sorted(counts.items()))
    sys.stdout.write(f"{minutes} minutes, {counts.total():,} requests: {statuses}\n")
