"""Pack grocery orders of BED-BPP by rules and by learned values: python benchmarks/orders.py bed-bpp_v1.json

Takes the orders that bed_bpp_orders.json names from your copy of BED-BPP: outputs/orders/train.json, for
``experiment=orders``, and test.json. Plays the latter in both containers, with each pile in the physics engine. Adds
rows to docs/results/orders.csv; what is there is not played again. To repeat a row, delete it.
"""

import json
import sys
from pathlib import Path

from common import ROOT, append_rows, evaluate, read_rows

TABLE, FOLDER = ROOT / "docs" / "results" / "orders.csv", ROOT / "outputs" / "orders"
NAMES = Path(__file__).with_name("bed_bpp_orders.json")
CONTAINERS = {"rollcontainer": "bed_bpp_roll", "euro-pallet": "bed_bpp"}  # target in the file -> benchmark
#: By their names in the table.
PLANNERS = {
    "orders": "checkpoint=pretrained/orders",
    "gopt_rs": "checkpoint=pretrained/gopt_rs",
    "corner": "planner=corner",
    "joint_dbl": "planner=joint_dbl",
    "best_fit": "planner=best_fit",
    "heightmap_minimisation": "planner=heightmap_minimisation",
}


def extract(source: Path) -> dict[str, int]:
    """Write the orders to train and to test on, and return the number of those to test on, by their target."""
    orders, names = json.loads(source.read_text()), json.loads(NAMES.read_text())
    if missing := [name for part in names.values() for name in part if name not in orders]:
        sys.exit(f"{source}: no order {missing[0]}; expected the whole of BED-BPP, bed-bpp_v1.json")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for part, some in names.items():
        (FOLDER / f"{part}.json").write_text(json.dumps({name: orders[name] for name in some}))
    targets = [orders[name]["properties"]["target"] for name in names["test"]]
    return {target: targets.count(target) for target in CONTAINERS}


def play(target: str, planner: str, episodes: int) -> dict:
    """Return a row of the table."""
    words = [f"benchmark={CONTAINERS[target]}", PLANNERS[planner], f"evaluation.episodes={episodes}", "physics=settle"]
    result = evaluate(FOLDER / f"{target}-{planner}", f"items.path={FOLDER / 'test.json'}", *words)
    row = {"container": target, "planner": planner, "episodes": episodes}
    parts = {"placed": result["share_placed"], "filled": result["true_occupancy"]}
    for name, part in (parts | {"kept": result["physics"]["carried_out"]}).items():
        row |= {name: part["mean"], f"{name}_low": part["ci95"][0], f"{name}_high": part["ci95"][1]}
    return row | {"ms": result["latency_ms"]["p50"]}


def main(words: list[str]) -> None:
    if len(words) != 1:
        sys.exit("expected the path of bed-bpp_v1.json, from https://github.com/floriankagerer/bed-bpp-env")
    counts = extract(Path(words[0]))
    known = {(row["container"], row["planner"]) for row in read_rows(TABLE)}
    for target, episodes in counts.items():
        for planner in PLANNERS:
            if (target, planner) not in known:
                append_rows(TABLE, [play(target, planner, episodes)])


if __name__ == "__main__":
    main(sys.argv[1:])
