"""Plans of recorded episodes, and how they were carried out."""

from pickplace.physics.outcome import Outcome
from pickplace.physics.plans import EpisodePlan, Placement, Point
from pickplace.rules.cell import CellSpec
from pickplace.views.motion import CarriedOut
from pickplace.views.recording import Recording

#: What the reader of a replay is told: a sentence about the lost item, and a word or two.
ENDINGS = {
    "done": ("Carried out: every item stayed in its place.", "carried out"),
    "collapsed": ("Item {} left its place.", "item {} left its place"),
    "effector_contact": ("The gripper hit something while it moved item {}.", "gripper hit something"),
    "wedged": ("Item {} was not in its place when it was released.", "item {} wedged"),
    "disturbed": ("Another item in the bin moved when item {} was taken.", "moved another item"),
    "dropped": ("The suction did not hold item {}.", "item {} not held"),
    "diverged": ("The simulation became impossible.", "simulation diverged"),
}


def plan_of(recording: Recording, cell: CellSpec, cell_size: float) -> EpisodePlan:
    """Return the plan of a recorded episode; ``cell_size`` is the side of a cell in metres."""

    def metres(*values: float) -> Point:
        """Lengths in cells, of which a third one is a height, in metres."""
        scales = (cell_size, cell_size, cell_size * cell.height_unit)
        # Rounded to nanometres: 0.15000000000000002 would only be harder to read.
        return tuple(round(value * scale, 9) for value, scale in zip(values, scales, strict=False))

    def middle(corner, sides) -> Point:
        return metres(*(at + side / 2 for at, side in zip(corner, sides, strict=True)))

    tote = metres(*cell.tote_size[:2], recording.tote_height)
    sizes = tote, metres(*cell.bin_size), metres(*cell.effector_size)
    plan = EpisodePlan(recording.episode, *sizes, body=body_of(cell, cell_size))
    for move in recording.moves:
        if not move.failure:
            x, y, w, d = move.footprint
            shape = cell.effector(move.rotation)
            placement = Placement(
                metres(x, y, move.z), metres(w, d, move.item[4]), metres(*move.item[:2]),
                middle(move.pick, cell.effector_size), middle(move.place, shape[:2]), 90 * move.rotation,
                tuple((*metres(*other[:2]), *metres(*other[2:])) for other in move.others),
            )  # fmt: skip
            plan.placements.append(placement)
    return plan


def body_of(cell: CellSpec, cell_size: float) -> tuple[Point, ...]:
    """Return the rectangles of the end effector's body in metres; none if it is one rectangle."""
    boxes = cell.effector(0).body
    return tuple(tuple(round(part * cell_size, 9) for part in box) for box in boxes) if len(boxes) > 1 else ()


def motion_for_replay(outcome: Outcome, cell_size: float) -> CarriedOut:
    """Return what a replay shows of an outcome and its motion; ``cell_size`` is the side of a cell in metres."""
    assert outcome.motion is not None
    number = None if outcome.lost is None else outcome.lost + 1
    ending, label = (
        text.format(number) for text in ENDINGS.get(outcome.ending, (f"Item {{}}: {outcome.ending}.", outcome.ending))
    )
    return CarriedOut(ending, label, outcome.lost, outcome.placed, outcome.occupancy, cell_size, outcome.motion)
