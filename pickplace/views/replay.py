"""Pages, pictures and animations that show recorded episodes."""

import base64
import io
import json
import re
import zlib
from functools import cache
from html import escape
from pathlib import Path

import numpy as np

from pickplace.rules.cell import CellSpec
from pickplace.rules.state import Failure
from pickplace.views.figures import save
from pickplace.views.motion import Outcome
from pickplace.views.recording import FULL, InBin, Recording
from pickplace.views.scene import draw_scene, item_colours

ASSETS = Path(__file__).resolve().parent / "assets"


# ---------------------------------------------------------------------- the page
def page(recordings: list[Recording], cell: CellSpec, title: str, at_end: bool = False) -> str:
    """Return a self-contained HTML page that replays episodes in 3D; it loads nothing from a network.

    Args:
        recordings: at least one episode.
        cell: the sizes.
        title: a short line, such as the planner's name and the stream.
        at_end: open at the end of the first episode instead of its beginning.
    """
    items = [item for one in recordings for move in one.moves for item in (move.item, *move.others)]
    colours = item_colours(items + [item for one in recordings for item in one.waiting])
    motion = next((one.carried_out.motion for one in recordings if one.carried_out and one.carried_out.motion), None)
    data = {
        "title": title,
        "step": len(recordings[0].moves) if at_end else 0,
        # In cells, from the tote's corner.
        "binAt": [round(at / cell.cell_size, 6) for at in motion.bin] if motion and motion.bin else None,
        "bin": [*cell.bin_size[:2], _cells(cell.bin_size[2], cell)],
        "tote": cell.tote_size[:2],
        **effector_parts(cell),
        "colours": {f"{w},{d},{_cells(h, cell)}": colour for (w, d, h), colour in colours.items()},
        "episodes": [_episode(recording, cell) for recording in recordings],
    }
    packed = base64.b64encode(zlib.compress(json.dumps(data, separators=(",", ":")).encode(), 9)).decode()
    return fill_template("replay.html", title=escape(title), data=packed)


def effector_parts(cell: CellSpec) -> dict:
    """Return the parts of the end effector that a page draws: its sides, its body's rectangles, its cup's cells."""
    cups = [[x, y] for x, column in enumerate(cell.gripper.cup_mask) for y, is_cup in enumerate(column) if is_cup]
    return {"effector": cell.gripper.size, "body": cell.effector(0).body, "cups": cups}


@cache
def asset(name: str) -> str:
    """Return the text of a file from which pages are made."""
    return (ASSETS / name).read_text(encoding="utf-8")


def fill_template(template: str, **parts: str) -> str:
    """Fill a template, in which ``{{name}}`` stands for one of the parts, or for a part that all pages share."""
    shared = {
        "style": asset("page.css").rstrip(),
        "scene": asset("scene.js").rstrip(),
        "three": asset("three.min.js").replace("</script", "<\\/script"),  # this would end the script element
    }
    # In one pass, so that the content of a part is not read as a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: {**shared, **parts}[mark[1]], asset(template))


def _cells(height: int, cell: CellSpec) -> int | float:
    """Return a height in cells, without the rounding errors of floating point."""
    cells = round(height * cell.height_unit, 9)
    return int(cells) if cells.is_integer() else cells


def _episode(recording: Recording, cell: CellSpec) -> dict:
    """Return the page's data of an episode; all lengths are in cells."""
    heat = [move.heat for move in recording.moves if move.heat is not None]
    ending = recording.describe_ending(cell)
    label = "goes on" if recording.ending is None else "full" if ending == FULL else recording.ending.label
    # One flat list a move: 5 of the item, 2 pick, 2 place, rotation, 4 of the footprint, z, failure code.
    moves = [
        [*_item(move.item, cell), *move.pick, *move.place, move.rotation, *move.footprint, _cells(move.z, cell),
         int(move.failure)]
        for move in recording.moves
    ]  # fmt: skip
    facts = {
        "episode": recording.episode,
        "height": _cells(recording.tote_height, cell),
        "occupancy": recording.occupancy,
        "ending": ending,
        "label": label,
        "failed": recording.ending not in (None, Failure.NONE, Failure.STUCK),
        "stuck": recording.ending == Failure.STUCK and ending != FULL,
        "waiting": [_item(item, cell) for item in recording.waiting],
        "moves": moves,
        "others": [[_item(item, cell) for item in move.others] for move in recording.moves],
        "coming": [[_item(item, cell) for item in move.coming] for move in recording.moves],
        "heat": base64.b64encode(np.stack(heat).tobytes()).decode() if heat else None,
    }
    return facts | (_physics(recording.carried_out, facts, cell) if recording.carried_out else {})


def _physics(outcome: Outcome, facts: dict, cell: CellSpec) -> dict:
    """Return the entries that physics changes in the page's data of an episode, and its motion."""
    lost, motion = outcome.lost is not None, outcome.motion
    sentence = outcome.sentence or f"Carried out: {outcome.ending}."
    changed = {
        "occupancy": outcome.occupancy,
        "ending": sentence if lost else f"{sentence} {facts['ending']}".strip(),
        "label": (outcome.label or outcome.ending) if lost else facts["label"],
        "failed": lost or facts["failed"],
        "stuck": facts["stuck"] and not lost,
    }
    if motion:
        changed["motion"] = {
            "lost": outcome.lost,
            "placed": outcome.placed,
            "ends": motion.ends,
            "plate": _poses(motion.plate, cell.cell_size),
            "boxes": [_poses(poses, cell.cell_size) for poses in motion.boxes],
            "left": [[round(side / cell.cell_size, 6) for side in sides] for sides in motion.left],
        }
    return changed


def _poses(poses: list[tuple[float, ...]], cell_size: float) -> list[int]:
    """Return poses as one list: 8 numbers each, positions in 1/1000 of a cell, and quaternions times 1000."""
    scale = np.array([1, *[1000 / cell_size] * 3, *[1000] * 4])
    return np.rint(np.array(poses).reshape(-1, 8) * scale).astype(int).ravel().tolist()


def _item(item: InBin, cell: CellSpec) -> list[int | float]:
    """Return an item ``(x, y, w, d, h)`` with its height in cells."""
    return [*item[:4], _cells(item[4], cell)]


# ---------------------------------------------------------------------- pictures
def picture(recording: Recording, cell: CellSpec, path: Path) -> None:
    """Draw the tote at the end of an episode with its height map, as PNG, PDF and SVG.

    Args:
        recording, cell: the episode and the sizes.
        path: the PNG to write; PDF and SVG beside it.
    """
    save(draw_scene(recording, cell, item_colours(recording.boxes)), path)


def animation(
    recording: Recording, cell: CellSpec, path: Path, seconds: float = 12.0, frames: int = 120, dpi: int = 60
) -> None:
    """Write a GIF of the tote being packed.

    Args:
        recording, cell: the episode and the sizes.
        path: the file to write.
        seconds: length of the animation; the last picture stays for two more seconds.
        frames: greatest number of pictures; moves of a longer episode are left out.
        dpi: pixels an inch; a picture is 12 inches wide.
    """
    from PIL import Image  # comes with matplotlib

    count = len(recording.moves)
    colours = item_colours(recording.boxes)
    images = []
    for moves in sorted({round(index) for index in np.linspace(0, count, min(frames, count + 1))}):
        buffer = io.BytesIO()
        draw_scene(recording, cell, colours, moves).savefig(buffer, format="png", dpi=dpi)
        images.append(Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE))
    durations = [max(20, round(1000 * seconds / len(images)))] * len(images)
    durations[-1] += 2000
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
