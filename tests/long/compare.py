"""Compare this checkout with an older one on the same machine: trainings, shipped weights, benchmarks, robot plans.

python tests/long/compare.py <older checkout> [--match REGEX] [--episodes 100] [--folder outputs/compare] [--list]

Each case runs in both checkouts with one thread. Trainings must leave the same metrics, except times, and the same
tensors; evaluations the same episodes; robot plans the same fields. What the older checkout wrote is kept in the
folder and used again.
"""

import argparse
import csv
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]

TRAINING = ["threads=1", "evaluation.episodes=16", "evaluation.batch_size=16"]
#: A few batches each, through all phases, with a validation and a checkpoint within.
TRAININGS = {
    "quick": "experiment=quick total_frames=8192 evaluation_interval=4096",
    "a2c": "experiment=quick algo=a2c total_frames=6144 evaluation_interval=4096",
    "paper_fast": "experiment=paper_fast env.num_envs=256 total_frames=3072 evaluation_interval=2048",
    "mixed_grasp": "experiment=mixed_grasp total_frames=6144 evaluation_interval=4096 warm_start.frames=2048"
    " warm_start.critic_frames=2048",
    "mixed": "experiment=mixed total_frames=8192 evaluation_interval=4096",
    "afterstate": "experiment=afterstate benchmark=gopt_rs total_frames=8192 evaluation_interval=4096",
    "warehouse": "experiment=warehouse total_frames=3072 evaluation_interval=2048"
    " warm_start.critic_frames=1024 evaluation.episodes=2",
    "imitation": "experiment=quick warm_start=imitate warm_start.frames=4096 warm_start.critic_frames=2048"
    " total_frames=8192 evaluation_interval=4096",
    "imitation_a2c": "experiment=quick algo=a2c warm_start=imitate warm_start.frames=2048"
    " warm_start.critic_frames=2048 total_frames=6144 evaluation_interval=4096",
    "individual_rl": "experiment=paper_fast model=individual_rl env.num_envs=256 total_frames=2048"
    " evaluation_interval=2048",
    "typical": "experiment=paper_fast model=typical env.num_envs=256 total_frames=2048 evaluation_interval=2048"
    " env.tote_size=[6,6,2]",
    "multi_sync": "experiment=quick collector=multi_sync curriculum=mixture total_frames=6144 evaluation_interval=4096",
}
#: Planners without weights, and searches, on few episodes.
EVALUATIONS = {
    **{f"mixed-{name}": f"planner={name} items=mixed env.tote_size=[8,8,8]" for name in ("joint_dbl", "corner")},
    **{
        f"mixed-{name}": f"planner={name} items=mixed env.tote_size=[6,6,5]"
        for name in ("best_fit", "online_bph", "heightmap_minimisation", "individual_heuristic", "random", "uniform")
    },
    "mcts": "planner=mcts planner.simulations=20 evaluation.episodes=2",
    "lookahead": "checkpoint=pretrained/r4 planner=lookahead evaluation.episodes=4",
    "settle": "checkpoint=pretrained/mixed physics=settle evaluation.episodes=4",
    "execute": "checkpoint=pretrained/mixed physics=execute evaluation.episodes=2",
}
#: Values of ``evaluation.json`` that must agree, by their place in it.
RESULTS = ("occupancy.per_episode", "items_placed", "failures", "feasible_action_share", "physics.carried_out")
ROBOT_SCENES = 30  # of each of the 16 planners and grippers: 480 plans


class Case(NamedTuple):
    """One comparison."""

    name: str
    command: str  # "train", "evaluate" or "robot"
    words: list[str]


def benchmark_words() -> dict[str, list[str]]:
    """Return the command line of each published row of the packing benchmarks."""
    code = "import json, packing; rows = {r.name: r.words() for r in packing.rows()}"
    code += "; print(json.dumps({name: rows[name] for name in packing.read() if name in rows}))"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "benchmarks", env=environment(ROOT),
                         check=True, capture_output=True, text=True)  # fmt: skip
    left_out = ("physics=", "evaluation.", "threads=")
    return {
        name: [word for word in words if not word.startswith(left_out)]
        for name, words in json.loads(out.stdout).items()
    }


def cases(old: Path, episodes: int) -> Iterator[Case]:
    """Yield all cases: trainings, searches and heuristics, cards, rows of benchmarks, and robot plans."""
    for name, line in TRAININGS.items():
        words = [*TRAINING, *line.split()]
        yield Case(f"train-{name}", "train", words)
    common = ["threads=1", "evaluation.latency_decisions=0", "evaluation.replay=0"]
    for name, line in EVALUATIONS.items():
        words = [*common, "evaluation.episodes=20", *line.split()]
        yield Case(f"planner-{name}", "evaluate", words)
    for path in sorted((old / "pickplace" / "pretrained").glob("*/card.json")):
        card = json.loads(path.read_text())
        for claimed in card["evaluations"]:
            count = min(episodes, claimed["episodes"])
            words = [*common, f"checkpoint={card['name']}", f"evaluation.episodes={count}"]
            words += [f"env.{key}={claimed['env'][key]}".replace(" ", "") for key in ("tote_size", "rotations")]
            words += [f"evaluation.{key}={claimed[key]}" for key in ("seed", "stream")]
            words += [f"planner.candidates={claimed['candidates']}"]
            size = "x".join(map(str, claimed["env"]["tote_size"]))
            yield Case(f"card-{path.parent.name}-{size}-K{claimed['candidates']}", "evaluate", words)
    for name, words in benchmark_words().items():
        yield Case(f"benchmark-{name}", "evaluate", [*words, *common, f"evaluation.episodes={episodes}"])
    yield Case("robot-plans", "robot", [])


def environment(checkout: Path) -> dict[str, str]:
    """Return the environment variables with which Python imports a checkout, with one thread."""
    return os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def play(case: Case, checkout: Path, folder: Path) -> None:
    """Run a case in a checkout, unless the folder has what an equal command wrote."""
    stamp = folder / "words.json"
    if checkout != ROOT and stamp.is_file() and json.loads(stamp.read_text()) == case.words:
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if case.command == "robot":
        command = [
            sys.executable,
            str(ROOT / "tests/long/robot_plans.py"),
            str(ROBOT_SCENES),
            str(folder / "plans.jsonl"),
        ]
    else:
        start = f"from pickplace.cli import {case.command}; {case.command}()"
        command = [sys.executable, "-c", start, *case.words, f"hydra.run.dir={folder}/run"]
    with (folder / "log").open("w") as log:
        done = subprocess.run(command, cwd=checkout, env=environment(checkout), stdout=log, stderr=subprocess.STDOUT)
    if done.returncode:
        raise RuntimeError(f"exit code {done.returncode}, see {folder / 'log'}")
    stamp.write_text(json.dumps(case.words))


def tensor_differences(old: dict[str, Tensor], new: dict[str, Tensor]) -> list[str]:
    """Return a line for each tensor of two checkpoints that differs or has no counterpart."""
    found = [f"{name}: only in one checkpoint" for name in sorted(old.keys() ^ new.keys())]
    for name in old.keys() & new.keys():
        one, other = old[name], new[name]
        if one.shape != other.shape or one.dtype != other.dtype or not torch.equal(one, other):
            found.append(f"{name}: differs")
    return found


def metric_differences(old: Path, new: Path) -> list[str]:
    """Return a line for each metric of two ``metrics.csv`` that differs, except times."""
    tables = []
    for path in (old, new):
        with path.open(newline="") as file:
            tables.append([{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)])
    if len(tables[0]) != len(tables[1]):
        return [f"metrics.csv: {len(tables[0])} rows, and {len(tables[1])}"]
    pairs = list(zip(*tables, strict=True))
    return [
        f"{key}, row {number}: {a.get(key)}, and {b.get(key)}"
        for number, (a, b) in enumerate(pairs)
        for key in sorted({*a, *b})
        if (a.get(key) or "") != (b.get(key) or "")
    ]


def value_at(result: dict, place: str):
    """Return the value at a dotted place, or None."""
    for key in place.split("."):
        result = result.get(key) if isinstance(result, dict) else None
    return result


def differences(case: Case, old: Path, new: Path) -> list[str]:
    """Return a line for each difference between what two checkouts wrote."""
    if case.command == "robot":
        lines = [(folder / "plans.jsonl").read_text().splitlines() for folder in (old, new)]
        count = sum(a != b for a, b in zip(*lines, strict=False)) + abs(len(lines[0]) - len(lines[1]))
        return [f"{count} of {len(lines[0])} plans"] if count or not lines[0] else []
    if case.command == "train":
        state = Path("run", "checkpoints", "last", "state.safetensors")
        found = tensor_differences(load_file(old / state), load_file(new / state))
        return found + metric_differences(old / "run" / "metrics.csv", new / "run" / "metrics.csv")
    results = [json.loads((folder / "run" / "evaluation.json").read_text()) for folder in (old, new)]
    found = []
    for place in RESULTS:
        ours, theirs = (value_at(result, place) for result in results)
        if ours != theirs:
            pairs = isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs)
            count = f", {sum(a != b for a, b in zip(ours, theirs, strict=True))} episodes" if pairs else ""
            found.append(f"{place} differs{count}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="an older checkout")
    parser.add_argument("--match", default="", help="regular expression: names of the cases that are compared")
    parser.add_argument("--skip", default="^$", help="regular expression: names of the cases that are left out")
    parser.add_argument("--episodes", type=int, default=100, help="of a card and of a row of a benchmark, at most")
    parser.add_argument("--folder", type=Path, default=ROOT / "outputs" / "compare")
    parser.add_argument("--list", action="store_true", help="list the cases only")
    given = parser.parse_args()
    old, folder, failed = given.old.resolve(), given.folder.resolve(), 0
    for case in cases(old, given.episodes):
        if not re.search(given.match, case.name) or re.search(given.skip, case.name):
            continue
        if given.list:
            sys.stdout.write(" ".join([case.name, *case.words]) + "\n")
            continue
        try:
            for name, checkout in (("old", old), ("new", ROOT)):
                play(case, checkout, folder / name / case.name)
            found = differences(case, folder / "old" / case.name, folder / "new" / case.name)
        except (RuntimeError, OSError, ValueError) as error:
            found = [str(error)]
        failed += bool(found)
        lines = [f"{'DIFFERS' if found else 'equal':8}{case.name}", *(f"    {line}" for line in found[:8])]
        sys.stdout.write("\n".join(lines) + "\n")
        sys.stdout.flush()
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
