"""Feeds the planner and its JSON lines with damaged requests: python tests/fuzz.py [minutes] [seed].

Each line must be answered in one line of strict JSON, with a plan or with an error in one sentence, and each map in
Python with a plan or a ``DepthMapError``. A plan is judged by the rules. What breaks this is printed, and fails.
"""

import contextlib
import copy
import json
import random
import sys
import time

import numpy as np
import torch

from pickplace import Planner, Rules
from pickplace.policies.actors import fcn_grasp
from pickplace.robot.json_lines import answer
from pickplace.robot.planner import DepthMapError
from pickplace.task.geometry import Item

DEFAULTS = {"tote_height": None, "cell_size": None, "tolerance": 0.25, "alternatives": 3}
ODD = [
    None, True, False, 0, -0.0, -1, 0.5, 1e-320, 5e-324, 1e308, -1e308, 2**31, 2**53 + 1, 2**63, 2**64, 10**400, "",
    "x", "6", "\ud800", "\u0000", [], {}, [[]], [[[]]], [[1, 2], [3]], {"a": 1}, 0.24999999999, 0.499999999, 0.05,
    1048576, 1048575,
]  # fmt: skip
TEXTS = [
    "NaN",
    "Infinity",
    "-Infinity",
    "1e999",
    "-1e999",
    "9" * 4299,
    "9" * 5000,
    "[" * 900,
    "[" * 200_000,
    "1.",
    "00",
    "{}",
]
KEYS = ["id", "bin_depth", "tote_depth", "tote_height", "cell_size", "tolerance", "alternatives", "more"]


def odd(draw: random.Random):
    """Something that is hardly ever right; a copy, for it may be damaged further."""
    return copy.deepcopy(draw.choice(ODD))


def request(draw: random.Random, rules: Rules) -> dict:
    """A request as a camera would send it."""
    (bin_w, bin_d, _), (tote_w, tote_d, rim) = rules.bin_size, rules.tote_size
    w, d, h = draw.randint(1, 3), draw.randint(1, 3), draw.randint(1, 3)
    x, y = draw.randint(0, bin_w - w), draw.randint(0, bin_d - d)
    bin_depth = np.zeros((bin_w, bin_d), dtype=int)
    bin_depth[x : x + w, y : y + d] = h
    tote_depth = np.array([[draw.randint(0, rim) for _ in range(tote_d)] for _ in range(tote_w)])
    return {"bin_depth": bin_depth.tolist(), "tote_depth": tote_depth.tolist()}


def damage(draw: random.Random, given: dict) -> dict:
    """A request of which some parts are something else."""
    for _ in range(draw.choice((0, 1, 1, 1, 2, 4))):
        key = draw.choice(KEYS)
        rows, kind = given.get(key), draw.random()
        if kind < 0.15:
            given.pop(key, None)
        elif kind < 0.5 or not isinstance(rows, list) or not rows:
            given[key] = odd(draw)
        elif kind < 0.6:
            given[key] = rows[:-1] if draw.random() < 0.5 else [*rows, rows[0]]
        elif isinstance(row := draw.choice(rows), list) and row:
            at = draw.randrange(len(row))
            row[at] = (
                odd(draw)
                if draw.random() < 0.5 or not isinstance(row[at], int)
                else row[at] + draw.choice((-1, 1, 0.2, 0.3))
            )
        else:
            rows[draw.randrange(len(rows))] = odd(draw)
    return given


def line_of(draw: random.Random, given: dict) -> bytes:
    """The request in a line, sometimes with other bytes in it."""
    text = json.dumps(given)
    if draw.random() < 0.2:  # what json.dumps would not write
        places = [at for at, letter in enumerate(text) if letter in "0123456789"] or [0]
        at = draw.choice(places)
        text = text[:at] + draw.choice(TEXTS) + text[at + 1 :]
    line = text.encode(draw.choice(("utf-8", "utf-8", "utf-8", "utf-16", "latin-1")))
    for _ in range(draw.choice((0, 0, 0, 1, 3))):
        at, kind = draw.randrange(len(line) + 1), draw.random()
        if kind < 0.3:
            line = line[:at] + bytes([draw.randrange(256)]) + line[at + 1 :]
        elif kind < 0.6:
            line = line[:at] + line[at + draw.randint(1, 9) :]
        elif kind < 0.8:
            line = line[:at]
        else:
            line = line[:at] + line[max(0, at - 20) :]
    return line


def check_line(planner: Planner, line: bytes) -> str:
    """Answer a line; its status.

    Raises:
        AssertionError: if the answer is not as promised.
    """
    reply = answer(planner, line, DEFAULTS)
    text = json.dumps(reply, allow_nan=False)
    assert "\n" not in text and json.loads(text).keys() == reply.keys()
    if "error" in reply:
        assert set(reply) <= {"id", "error"} and reply["error"].strip() and "\n" not in reply["error"]
        assert len(reply["error"]) < 2000, "a sentence is short"
        return "error"
    given = json.loads(line)
    rules, unit = planner.rules, given.get("cell_size") or 1.0
    rim = round((given.get("tote_height") or rules.tote_size[2] * unit) / unit)
    heights = rim - np.round(np.array(given["tote_depth"], dtype=float) / unit).astype(int)
    check_plan(planner, np.round(np.array(given["bin_depth"], dtype=float) / unit).astype(int), heights, rim, reply)
    return reply["status"]


def check_plan(planner: Planner, bin_cells: np.ndarray, heights: np.ndarray, rim: int, plan: dict) -> None:
    """A plan's status, and its effect, by the rules."""
    rules = planner.rules
    item = rules.read_item(torch.tensor(bin_cells)[None].float())
    tote, at = torch.tensor(heights, dtype=torch.int32)[None], torch.tensor([rim])
    feasible = rules.action_mask(rules.placements(tote, at, item))[0]
    nothing = "stuck" if rules.outcome_mask(rules.placements(tote * 0, at, item)).any() else "impossible"
    assert feasible.any() if plan["status"] in ("ok", "rejected") else plan["status"] == nothing and not feasible.any()
    if plan["status"] != "ok":
        return
    assert feasible[plan["action"]]
    step = rules.apply(tote, at, Item(*item), torch.tensor([plan["action"]]))
    share = (plan["occupancy_after"] - plan["occupancy_before"]) * rim * rules.num_places
    assert abs(share - int(item.w * item.d * item.h)) < 1e-6 and int(step.failure) == 0


def as_array(draw: random.Random, value):
    """The value as an array of some type, turned or spoilt at times; as it is if numpy refuses."""
    kind = draw.choice((None, None, None, float, "f4", "f2", "i1", "u1", "u8", bool, complex, object, "U3", "M8[s]"))
    with contextlib.suppress(ValueError, TypeError, OverflowError), np.errstate(all="ignore"):
        value = np.array(value, dtype=kind)
        if value.ndim and draw.random() < 0.3:
            value = draw.choice((value.T, value[None], value[..., ::-1]))
        if value.dtype.kind == "f" and value.size and draw.random() < 0.2:
            value.flat[draw.randrange(value.size)] = draw.choice((float("nan"), float("inf"), -0.0))
    return value


def check_maps(planner: Planner, draw: random.Random, given: dict) -> str:
    """Plan from arrays; its status."""
    maps = {key: as_array(draw, given.get(key)) for key in ("bin_depth", "tote_depth")}
    rest = {key: given[key] for key in ("tote_height", "cell_size", "tolerance", "alternatives") if key in given}
    try:
        plan = planner.plan(**maps, **rest).as_dict()
    except DepthMapError as error:
        assert str(error) and "\n" not in str(error)
        return "error"
    json.dumps(plan, allow_nan=False)
    return plan["status"]


def fuzz(minutes: float, seed: int) -> dict[str, int]:
    """Feed planners of some sizes for so long; how often they answered what."""
    draw, end, counts = random.Random(seed), time.monotonic() + 60 * minutes, {}
    torch.manual_seed(seed)
    all_rules = [Rules(), Rules((4, 6, 2), (5, 7, 6), (2, 3), 2), Rules((3, 3, 1), (4, 4, 3), (1, 1), 1, "overlap")]
    planners = [
        Planner(rules, fcn_grasp(rules, True, filters=8, hidden=8).eval(), k) for rules in all_rules for k in ("all", 5)
    ]
    while time.monotonic() < end:
        planner = draw.choice(planners)
        given, line = damage(draw, request(draw, planner.rules)), b""
        try:
            if draw.random() < 0.7:
                line = line_of(draw, given)
                status = check_line(planner, line)
            else:
                status = check_maps(planner, draw, given)
        except Exception:
            told = f"{planner.rules.describe()}, candidates {planner._planner.candidates}: {given}"
            sys.stderr.write(f"case {sum(counts.values())} of seed {seed}, {told[:1500]}\n{line[:1500]}\n")
            raise
        counts[status] = counts.get(status, 0) + 1
    return counts


def main() -> None:
    given = sys.argv[1:]
    minutes, seed = given + ["60", "0"][len(given) :]
    counts = fuzz(float(minutes), int(seed))
    told = ", ".join(f"{count:,} {status}" for status, count in sorted(counts.items()))
    sys.stdout.write(f"{minutes} minutes, {sum(counts.values()):,} requests: {told}\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
