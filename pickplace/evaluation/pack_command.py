"""The ``pickplace-pack`` command: pack the orders of a file into containers."""

import argparse
import csv
import io
import json
import math
import re
from collections.abc import Container
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.validate import refuse_if

if TYPE_CHECKING:
    from pickplace.evaluation.filling import PackedContainer, PackedItem
    from pickplace.physics.plans import EpisodePlan

PAGE = re.compile(r"replay(_[1-9]\d*)?\.html")  # names of the pages


def main() -> None:
    """Entry point of ``pickplace-pack``."""
    with one_sentence():
        run(parser().parse_args())


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return Parser(
        prog="pickplace-pack",
        description="Pack the orders of a file into containers. Prints where each item goes, in which sequence; writes "
        "a table, the plan in BED-BPP's format, one for pickplace-physics, and a page that shows the containers in 3D.",
        epilog="The file's format: docs/train_your_own.md#2-describe-the-items",
        options={
            "order": {
                "help": "CSV with columns length, width, height, weight, and if there are any order, id, quantity, "
                "max_load, stackable, orientations; or JSON of BED-BPP",
            },
            "--container": {
                "required": True, "metavar": "LxWxH", "help": "inner sides of a container, such as 1200x800x1500; mm",
            },
            "--cell": {
                "type": int, "default": 20, "metavar": "MM", "help": "side of a cell; places are multiples of "
                "it (default %(default)s)",
            },
            "--unit": {
                "default": "mm", "metavar": "UNIT",
                "help": "of lengths without a unit in the header: mm (the default), cm or m",
            },
            "--keep-sequence": {"action": "store_true", "help": "put the items down in the sequence of the file"},
            "--tipping": {
                "action": "store_true",
                "help": "put items down on another side, too, unless their column orientations forbids it",
            },
            "--planner": {
                "metavar": "NAME",
                "help": "what chooses the places: best_fit, corner, joint_dbl, ... (default: heightmap_minimisation, "
                "and joint_dbl where that makes the last pile lower)",
            },
            "--out": {
                "metavar": "FOLDER", "default": "outputs/pack", "help": "where the files go (default %(default)s)",
            },
        },
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Pack the orders, print them and write the files.

    Raises:
        ValueError: for arguments or orders that cannot be used.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})x(\d{1,5})", args.container)
    refuse_if(not match, f"--container={args.container}: expected whole millimetres, such as 1200x800x1500.")
    length, width, height = map(int, match.groups() if match else ())
    container = length, width, height
    refuse_if(not min(container), f"--container={args.container}: expected sides of 1 mm or more.")
    from pickplace.common.files import replace_files
    from pickplace.common.validate import one_of
    from pickplace.evaluation.pack import OrderPacker
    from pickplace.items.order_file import MILLIMETRES, read_orders
    from pickplace.physics.plans import PLANS, EpisodePlan, to_lines
    from pickplace.views.replay import page

    notes: list[str] = []
    orders = read_orders(args.order, one_of("--unit", args.unit, MILLIMETRES), key="order", note=notes.append)
    packer = OrderPacker(container, args.cell, args.planner, args.tipping)
    for order in orders:  # before the first of them is packed
        packer.check(order.items)
    folder, rows, recorded, tables = Path(args.out), [], [], []
    folder.mkdir(parents=True, exist_ok=True)
    bed_bpp: dict[str, list[dict]] = {}
    plans: list[EpisodePlan] = []
    for order in orders:
        cell, containers = packer.pack(order.items, args.keep_sequence)
        name, keys = _free_names(order.name or Path(args.order).stem, len(containers), bed_bpp)
        for place, (key, each) in enumerate(zip(keys, containers, strict=True), 1):
            table = [_row(name, place, step, packed) for step, packed in enumerate(each.items, 1)]
            if args.tipping:
                table = [
                    {**row, "orientation": packed.orientation} for row, packed in zip(table, each.items, strict=True)
                ]
            tables.append(_text(name, place, len(containers), each, table))
            rows += table
            bed_bpp[key] = [_as_bed_bpp(packed) for packed in each.items]
            plans.append(_as_plan(len(plans), container, each))
        recorded.append(([each.recording for each in containers], cell, name))
    # The pages of an earlier run: other commands write no such plan.
    earlier = [path for path in folder.iterdir() if PAGE.fullmatch(path.name)] if (folder / "plan.csv").exists() else []
    columns = io.StringIO()
    writer = csv.DictWriter(columns, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files = [f"replay_{number}.html" for number in range(1, len(orders) + 1)] if len(orders) > 1 else ["replay.html"]
    pages = ((file, page(*each)) for file, each in zip(files, recorded, strict=True))
    texts = [("plan.csv", columns.getvalue()), ("plan.json", json.dumps(bed_bpp, indent=1) + "\n")]
    replace_files(folder, chain(texts, [(PLANS, to_lines(plans))], pages))
    for old in [path for path in earlier if path.name not in files]:
        old.unlink()
    shown = " to ".join(dict.fromkeys((files[0], files[-1])))
    # After the files: a reader that ends early, such as head, must not cost the plan.
    notes = [f"{note}\n" for note in notes]
    write_output("".join([*tables, *notes, f"{folder}: plan.csv, plan.json, {PLANS}, {shown}\n"]))


def _free_names(name: str, count: int, taken: Container[str]) -> tuple[str, list[str]]:
    """Return the name of an order, and those of its containers in ``plan.json``; a used name gets more quotes."""
    while True:
        keys = [name, *(f"{name}#{place}" for place in range(2, count + 1))]
        if not any(key in taken for key in keys):
            return name, keys
        name += "'"


def _row(name: str, container: int, step: int, packed: "PackedItem") -> dict:
    """Return the row of an item in ``plan.csv``."""
    return {
        "order": name, "container": container, "step": step, "item": packed.number, "id": packed.item.id,
        **dict(zip(("x/mm", "y/mm", "z/mm"), packed.corner, strict=True)),
        **dict(zip(("along_x/mm", "along_y/mm", "height/mm"), packed.size, strict=True)), "turned": int(packed.turned),
        "weight/kg": packed.item.grams / 1000,
    }  # fmt: skip


def _text(name: str, place: int, count: int, container: "PackedContainer", rows: list[dict]) -> str:
    """Return the text that is printed for a container."""
    weight = sum(packed.item.grams for packed in container.items) / 1000
    top = math.ceil(10 * container.top - 1e-6) / 10
    lines = [
        f"{name}, container {place} of {count}: {len(rows)} item{'s' * (len(rows) != 1)}, "
        f"{container.occupancy:.1%} of its volume, {weight:,.1f} kg, {top:g} mm high"
    ]
    keys = ("step", "item", "id", "x/mm", "y/mm", "z/mm", "along_x/mm", "along_y/mm", "height/mm")
    cells = [
        keys,
        *([f"{row[key]:g}" if isinstance(row[key], float) else str(row[key]) for key in keys] for row in rows),
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines += ["  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in cells]
    return "\n".join(lines) + "\n\n"


def _as_bed_bpp(packed: "PackedItem") -> dict:
    """Return an action of a packing plan of BED-BPP: front left bottom corner; orientation 1: turned.

    BED-BPP does not know tipped items: they get the sides that they have as they lie. Its code needs whole numbers.
    """

    def whole(value: float) -> float:
        return int(value) if (value := round(value, 6)).is_integer() else value

    item, (x, y, height) = packed.item, map(whole, packed.size)
    length, width = (y, x) if packed.turned else (x, y)
    return {
        "item": {
            "article": item.article or item.id, "id": item.id, "product_group": item.product_group,
            "length/mm": length, "width/mm": width, "height/mm": height, "weight/kg": item.grams / 1000,
            "sequence": packed.number,
        },
        "flb_coordinates": [*map(whole, map(float, packed.corner))],
        "orientation": int(packed.turned),
    }  # fmt: skip


def _as_plan(number: int, container: tuple[int, ...], packed: "PackedContainer") -> "EpisodePlan":
    """Return the plan of a container for a physics engine, with the items' true sides and masses."""
    from pickplace.physics.plans import EpisodePlan, Placement

    def metres(values) -> tuple[float, ...]:
        return tuple(round(value / 1000, 9) for value in values)

    placements = [
        Placement(metres(each.corner), metres(each.size), mass=each.item.grams / 1000) for each in packed.items
    ]
    return EpisodePlan(number, metres(container), placements=placements)
