"""What a placement-only plan is worth: python benchmarks/reproduce/placement_only.py result.json packer=py3dbp ...

A public packer, installed from a registry, decides where each item of the test stream goes, in the order of arrival,
until it finds no place; it knows neither gripper nor bin. Its plan is then replayed under our rules. A placement can be
executed if the item comes to rest where it was planned, is supported, and some action sets it down there. Two shares
are told: of all placements, those that could be executed if all before them had been (by hand, if need be); and what of
the tote is filled when the first one cannot.
"""

import json
import sys
from pathlib import Path

import torch

from pickplace import PickPlaceEnv
from pickplace.evaluation.evaluate import confidence95
from pickplace.task.geometry import NEVER

STREAM, SEED = "test", 0


def py3dbp(size, turns: bool):
    """Greedy first fit at the corners of what is packed (https://pypi.org/project/py3dbp)."""
    from py3dbp import Bin, Item, Packer
    from py3dbp.constants import RotationType

    RotationType.ALL = [RotationType.RT_WHD, RotationType.RT_HWD][: 1 + turns]  # a robot does not tip items over
    packer, tote = Packer(), Bin("tote", *size, 10**9)

    def place(w, d, h):
        packed = len(tote.items)
        packer.pack_to_bin(tote, Item("item", w, d, h, 1))
        if len(tote.items) == packed:
            return None
        item = tote.items[-1]
        return *map(int, item.position), *map(int, item.get_dimension()[:2])

    return place


def rectpack(size, turns: bool):
    """MaxRects, bottom left, the first layer in which the item fits (https://pypi.org/project/rectpack)."""
    from rectpack import MaxRectsBl, PackingBin, PackingMode, newPacker

    wide, deep, high = size
    packer = newPacker(PackingMode.Online, PackingBin.BFF, MaxRectsBl, rotation=turns)
    packer.add_bin(wide, deep, count=high)
    count = 0

    def place(w, d, h):
        nonlocal count
        if h != 1:
            raise ValueError(f"rectpack packs layers of height 1, not an item of height {h}.")
        count += 1
        packer.add_rect(w, d, count)
        for layer, x, y, width, depth, number in packer.rect_list():
            if number == count:
                return x, y, layer, width, depth
        return None

    return place


PACKERS = {"py3dbp": py3dbp, "rectpack": rectpack}


def replay(env: PickPlaceEnv, packer) -> tuple[list[str], float, float]:
    """What became of each placement of an episode, the packer's own occupancy, and that at its first failure."""
    rules, volume = env.rules, rules_volume(env.rules)
    env.reset()
    place = packer(rules.tote_size, rules.rotations > 1)
    heights, height = env.heights.clone(), env.tote_height
    outcomes, filled, executed = [], 0, None
    for step in range(volume):
        address = [torch.tensor([value]) for value in (SEED, env.first_episode, step)]
        item = env.items.sample(STREAM, *address, rules.bin_size)
        w, d, h = (int(part) for part in (item.w, item.d, item.h))
        planned = place(w, d, h)
        if planned is None:
            break
        x, y, z, wide, deep = planned
        under = heights[0, x : x + wide, y : y + deep]
        rest = int(under.max())
        placements = rules.placements(heights, height, item)
        turned = int((wide, deep) != (w, d))
        reachable = bool(rules.outcome_mask(placements)[0, turned, x, y])
        if rest != z:
            outcome = "rests_elsewhere"
        elif placements.top[0, turned, x, y] == NEVER:  # it fits, so its support is too small
            outcome = "unstable"
        else:
            outcome = "executed" if reachable else "effector_collides"
        if outcome != "executed" and executed is None:
            executed = filled / volume
        outcomes.append(outcome)
        filled += w * d * h
        # As planned, so that what follows is judged by itself; what is already above it stays.
        heights[0, x : x + wide, y : y + deep] = under.clamp(min=z + h)
    return outcomes, filled / volume, filled / volume if executed is None else executed


def rules_volume(rules) -> int:
    """Cells of the tote."""
    wide, deep, high = rules.tote_size
    return wide * deep * high


def main() -> None:
    path, settings = Path(sys.argv[1]), dict(word.split("=", 1) for word in sys.argv[2:])
    packer = PACKERS[settings["packer"]]
    size = tuple(json.loads(settings["env.tote_size"]))
    episodes = int(settings.get("evaluation.episodes", 100))
    reasons, planned, reached, shares, whole = {}, [], [], [], 0
    for episode in range(episodes):
        env = PickPlaceEnv(
            tote_size=size,
            rotations=int(settings["env.rotations"]),
            num_envs=1,
            stream=STREAM,
            seed=SEED,
            first_episode=episode,
        )
        outcomes, occupancy, executed = replay(env, packer)
        for outcome in outcomes:
            reasons[outcome] = reasons.get(outcome, 0) + 1
        planned.append(occupancy)
        reached.append(executed)
        shares.append(outcomes.count("executed") / len(outcomes))
        whole += outcomes.count("executed") == len(outcomes)

    def figures(values):
        values = torch.tensor(values, dtype=torch.float64)
        return {"mean": float(values.mean()), "ci95": list(confidence95(values))}

    result = {
        "planner": settings["packer"],
        "episodes": episodes,
        "placements": dict(sorted(reasons.items())),
        "share_executed": figures(shares),
        "plans_executed_whole": whole,
        "occupancy_planned": figures(planned),
        "occupancy": figures(reached),
    }
    path.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
