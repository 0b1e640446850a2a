"""Make plans of recorded episodes."""

from pickplace.physics.plans import EpisodePlan, Placement, Point
from pickplace.rules.cell import CellSpec
from pickplace.views.recording import Recording


def plan_of(recording: Recording, cell: CellSpec) -> EpisodePlan:
    """Return the plan of a recorded episode."""

    def metres(*values: float) -> Point:
        # The third length, if there is one, is a height. Rounded, as 0.15000000000000002 is harder to read.
        scales = (cell.cell_size, cell.cell_size, cell.cell_size * cell.height_unit)
        return tuple(round(value * scale, 9) for value, scale in zip(values, scales, strict=False))

    def middle(corner, sides) -> Point:
        return metres(*(at + side / 2 for at, side in zip(corner, sides, strict=True)))

    gripped = not cell.tipping  # no gripper tips an item, so with tipping only places are planned
    placements = [
        Placement(
            metres(*move.footprint[:2], move.z), metres(*move.footprint[2:], move.item[4]), metres(*move.item[:2]),
            middle(move.pick, cell.gripper.size), middle(move.place, cell.effector(move.rotation)[:2]),
            90 * move.rotation, tuple((*metres(*other[:2]), *metres(*other[2:])) for other in move.others if gripped),
            move.grams / 1000,
        )
        for move in recording.moves
        if not move.failure
    ]  # fmt: skip
    return EpisodePlan(
        recording.episode, metres(*cell.tote_size[:2], recording.tote_height),
        metres(*cell.bin_size) if gripped else (), metres(*cell.gripper.size), placements, body_of(cell),
    )  # fmt: skip


def body_of(cell: CellSpec) -> tuple[Point, ...]:
    """Return the rectangles of the end effector's body in metres; empty if the body is a single rectangle."""
    boxes = cell.effector(0).body
    return tuple(tuple(round(part * cell.cell_size, 9) for part in box) for box in boxes) if len(boxes) > 1 else ()
