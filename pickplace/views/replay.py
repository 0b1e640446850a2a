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

from pickplace.task.cell import CellSpec
from pickplace.task.state import Failure
from pickplace.views.figures import draw_scene, item_colours
from pickplace.views.recording import FULL, Recording

ASSETS = Path(__file__).resolve().parent / "assets"


# ---------------------------------------------------------------------- the page
def page(recordings: list[Recording], cell: CellSpec, title: str) -> str:
    """Return a self-contained HTML page that replays episodes in 3D; it loads nothing from a network.

    Args:
        recordings: at least one episode.
        cell: the sizes.
        title: a short line, such as the planner's name and the stream.
    """
    colours = item_colours([box for recording in recordings for box in recording.boxes + _others(recording)])
    data = {
        "title": title,
        "bin": cell.bin_size,
        "tote": cell.tote_size,
        "effector": cell.effector_size,
        "height_unit": cell.height_unit,
        "colours": {",".join(map(str, kind)): colour for kind, colour in colours.items()},
        "episodes": [_episode(recording, cell) for recording in recordings],
    }
    packed = base64.b64encode(zlib.compress(json.dumps(data, separators=(",", ":")).encode(), 9)).decode()
    html = (ASSETS / "replay.html").read_text(encoding="utf-8")
    parts = {"title": escape(title), "data": packed, "three": _three()}
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], html)


@cache
def _three() -> str:
    return (ASSETS / "three.min.js").read_text(encoding="utf-8").replace("</script", "<\\/script")


def _others(recording: Recording) -> list[tuple[int, ...]]:
    """Return the items that are seen but not placed, as boxes."""
    items = [move.item for move in recording.moves if move.failure]
    items += [recording.waiting] if recording.waiting else []
    return [(0, 0, 0, *item[2:]) for item in items]


def _label(recording: Recording, ending: str) -> str:
    """Return why an episode ended, in a word or two, for a list of episodes."""
    if recording.ending is None:
        return "goes on"
    return "full" if ending == FULL else recording.ending.label


def _episode(recording: Recording, cell: CellSpec) -> dict:
    heat = [move.heat for move in recording.moves if move.heat is not None]
    ending = recording.describe_ending(cell.num_places)
    return {
        "episode": recording.episode,
        "height": recording.tote_height,
        "occupancy": recording.occupancy,
        "ending": ending,
        "briefly": _label(recording, ending),
        "failed": recording.ending not in (None, Failure.NONE, Failure.STUCK),
        "stuck": recording.ending == Failure.STUCK and ending != FULL,
        "waiting": recording.waiting,
        # One flat list a move: 5 of the item, 2 pick, 2 place, rotation, 4 of the footprint, z, failure code.
        "moves": [
            [*move.item, *move.pick, *move.place, move.rotation, *move.footprint, move.z, int(move.failure)]
            for move in recording.moves
        ],
        "heat": base64.b64encode(np.stack(heat).tobytes()).decode() if heat else None,
    }


# ---------------------------------------------------------------------- pictures for papers
def picture(recording: Recording, cell: CellSpec, path: Path, moves: int | None = None) -> None:
    """Draw the tote after a number of moves, beside its height map, as PNG or SVG.

    Args:
        moves: how many moves have been made; None: all.
    """
    colours = item_colours(recording.boxes)
    draw_scene(recording, cell, colours, moves).savefig(path, dpi=120)


def animation(recording: Recording, cell: CellSpec, path: Path, seconds: float = 12.0, frames: int = 120) -> None:
    """Write a GIF of the tote being packed.

    Args:
        seconds: how long it plays; the last picture stays for two more.
        frames: greatest number of pictures; a longer episode leaves moves out.
    """
    from PIL import Image  # comes with matplotlib

    count = len(recording.moves)
    shown = sorted({round(index) for index in np.linspace(0, count, min(frames, count + 1))})
    colours = item_colours(recording.boxes)
    images = []
    for moves in shown:
        buffer = io.BytesIO()
        draw_scene(recording, cell, colours, moves).savefig(buffer, format="png", dpi=60)
        images.append(Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE))
    each = max(20, round(1000 * seconds / len(images)))
    durations = [each] * (len(images) - 1) + [each + 2000]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
