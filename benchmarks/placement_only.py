"""Measure a placement-only packer: python benchmarks/placement_only.py packer=py3dbp env.rotations=4
env.tote_size=[6,6,5] result=result.json

A public packer plans where each item of the test stream goes, in order, until it finds no place. It knows neither
gripper nor bin. Its plan is then replayed under our rules: a placement is executable if the item rests where it was
planned, is supported, and a feasible action sets it down there.
"""

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from pickplace import PickPlaceEnv
from pickplace.evaluation.result import confidence95
from pickplace.rules.maps import NEVER
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.state import Item, State, surface_from
from pickplace.runs.provenance import commit


def py3dbp(size, turns: bool):
    """Place greedily at the corners of packed items (https://pypi.org/project/py3dbp)."""
    from py3dbp import Bin, Item, Packer
    from py3dbp.constants import RotationType

    RotationType.ALL = [RotationType.RT_WHD, RotationType.RT_HWD][: 1 + turns]  # a robot does not tip items over
    packer, tote = Packer(), Bin("tote", *size, 10**9)

    def place(w, d, h):
        packed = len(tote.items)
        packer.pack_to_bin(tote, Item("item", w, d, h, 1))
        if len(tote.items) == packed:
            return None
        return *map(int, tote.items[-1].position), *map(int, tote.items[-1].get_dimension()[:2])

    return place


def rectpack(size, turns: bool):
    """Place by MaxRects, bottom left, in the first layer where it fits (https://pypi.org/project/rectpack)."""
    from rectpack import MaxRectsBl, PackingBin, PackingMode, newPacker

    packer = newPacker(PackingMode.Online, PackingBin.BFF, MaxRectsBl, rotation=turns)
    packer.add_bin(*size[:2], count=size[2])
    numbers = iter(range(10**9))

    def place(w, d, h):
        number = next(numbers)
        packer.add_rect(w, d, number)
        found = (rect for rect in packer.rect_list() if rect[5] == number)
        return next(((x, y, layer, wide, deep) for layer, x, y, wide, deep, _ in found), None)

    return place


def planned_placements(env: PickPlaceEnv, packer) -> Iterator[tuple[Item, int, int, int, int, int]]:
    """Yield each item of the environment's first episode, and where it is planned to go: x, y, z and its sides."""
    place, volume = packer(env.cell.tote_size, env.cell.rotations > 1), math.prod(env.cell.tote_size)
    for step in range(volume):
        address = [torch.tensor([value]) for value in (0, env.first_episode, step)]
        item = env.items.sample("test", *address, env.cell.bin_size)
        if (planned := place(*(int(part) for part in (item.w, item.d, item.h)))) is None:
            return
        yield item, *planned


def replay(env: PickPlaceEnv, packer) -> tuple[list[str], float, float]:
    """Return what became of each placement, the planned occupancy, and the occupancy before the first failure."""
    cell, outcomes, filled, executed = env.cell, [], 0, None
    volume = math.prod(cell.tote_size)
    env.reset()
    heights, tote_height = env.state.heights, env.tote_height
    for item, x, y, z, wide, deep in planned_placements(env, packer):
        w, d, h = (int(part) for part in (item.w, item.d, item.h))
        turned, under = int((wide, deep) != (w, d)), heights[0, x : x + wide, y : y + deep]
        maps = placing_maps(cell, State(surface_from(heights), tote_height, item))
        if int(under.max()) != z:
            outcome = "rests_elsewhere"
        elif maps.top[0, turned, x, y] == NEVER:  # it fits, so its support is too small
            outcome = "unstable"
        else:
            outcome = "executed" if footprint_mask(cell, maps)[0, turned, x, y] else "effector_collides"
        executed = filled / volume if outcome != "executed" and executed is None else executed
        outcomes.append(outcome)
        filled += w * d * h
        heights[0, x : x + wide, y : y + deep] = under.clamp(min=z + h)  # as planned, executable or not
    return outcomes, filled / volume, filled / volume if executed is None else executed


def summary(values: list[float]) -> dict:
    """Return mean and 95% interval."""
    values = torch.tensor(values, dtype=torch.float64)
    return {"mean": float(values.mean()), "ci95": list(confidence95(values))}


def main() -> None:
    settings = dict(word.split("=", 1) for word in sys.argv[1:])
    cell = {"tote_size": json.loads(settings["env.tote_size"]), "rotations": int(settings["env.rotations"])}
    count = int(settings.get("evaluation.episodes", 100))
    played = []
    for episode in range(count):
        env = PickPlaceEnv(**cell, support="half", num_envs=1, stream="test", seed=0, first_episode=episode)
        played.append(replay(env, {"py3dbp": py3dbp, "rectpack": rectpack}[settings["packer"]]))
    shares = [outcomes.count("executed") / len(outcomes) for outcomes, _, _ in played]
    reached = [executed for _, _, executed in played]
    every = [outcome for outcomes, _, _ in played for outcome in outcomes]
    result = {
        "planner": settings["packer"],
        "env": {"bin_size": list(env.cell.bin_size), **cell},
        "items": {"kinds": None},
        "stream": "test",
        "seed": 0,
        "episodes": count,
        "placements": {outcome: every.count(outcome) for outcome in sorted(set(every))},
        "share_executed": summary(shares),
        "plans_executed_whole": shares.count(1.0),
        "occupancy_planned": summary([planned for _, planned, _ in played]),
        "occupancy": summary(reached) | {"per_episode": reached},
        "commit": commit(),
    }
    path = Path(settings["result"])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
