"""Recorded episodes, and the pages, pictures and animations that show them."""

import base64
import io
import json
import re
import zlib
from dataclasses import dataclass, field
from functools import cache
from html import escape
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from pickplace.task.geometry import Failure, Item, Rules
from pickplace.views.figures import draw_scene, item_colours

ASSETS = Path(__file__).resolve().parent / "assets"

#: Why an episode ended, for a reader who does not know the rules.
ENDINGS = {
    Failure.NONE: "The item stream is over.",
    Failure.PICK_MISS: "The gripper does not cover the item.",
    Failure.BIN_COLLISION: "The gripper would hit the bin's wall.",
    Failure.TOTE_COLLISION: "The gripper or the item would hit the tote's wall.",
    Failure.OVERFLOW: "The item would stick out of the tote.",
    Failure.ITEM_COLLISION: "The gripper would hit an item in the tote.",
    Failure.UNSTABLE: "The item would not rest stably.",
    Failure.STUCK: "This item fits nowhere any more.",
}
FULL = "The tote is full."

#: The same in a word or two, for a list of episodes.
BRIEFLY = {
    None: "goes on",
    Failure.NONE: "stream over",
    Failure.PICK_MISS: "missed the item",
    Failure.BIN_COLLISION: "hit the bin",
    Failure.TOTE_COLLISION: "hit the tote",
    Failure.OVERFLOW: "too high",
    Failure.ITEM_COLLISION: "hit an item",
    Failure.UNSTABLE: "unstable",
    Failure.STUCK: "no place left",
}


@dataclass
class Move:
    """One decision, and what came of it; all in cells."""

    item: tuple[int, ...]  # x, y, w, d, h in the bin
    pick: tuple[int, int]  # min corner of the end effector in the bin
    place: tuple[int, int]  # min corner of the turned end effector in the tote
    rotation: int  # quarter turns, counter-clockwise seen from above
    footprint: tuple[int, ...]  # x, y, w, d in the tote
    z: int  # height of the item's underside once it rests
    failure: Failure
    heat: np.ndarray | None = None  # uint8 [W_T, D_T]: the policy's preference for each place cell, 255 the highest


@dataclass
class Recording:
    """One episode, move by move."""

    episode: int  # its number in the stream
    tote_height: int
    moves: list[Move] = field(default_factory=list)
    ending: Failure | None = None  # None while it goes on; NONE when a recorded stream is over
    waiting: tuple[int, ...] | None = None  # the item that arrived last and fits nowhere, as `Move.item`
    occupancy: float = 0.0

    @property
    def boxes(self) -> list[tuple[int, ...]]:
        """The items placed, ``(x, y, z, w, d, h)`` each, in their order."""
        good = [move for move in self.moves if not move.failure]
        return [(*move.footprint[:2], move.z, *move.footprint[2:], move.item[4]) for move in good]

    def describe_ending(self, num_places: int) -> str:
        """Why the episode ended, in a sentence; empty while it goes on."""
        if self.ending is None:
            return ""
        volume = sum(w * d * h for *_, w, d, h in self.boxes)
        full = self.ending == Failure.STUCK and volume == num_places * self.tote_height
        return FULL if full else ENDINGS[self.ending]


def observe(
    rules: Rules, planner, observation: TensorDictBase, heights: Tensor, item: Item, action: Tensor
) -> list[Move]:
    """What the given decisions do, a :class:`Move` for each row.

    Args:
        rules: the task's sizes.
        planner: the planner that decided; if it has a ``heat_map`` it is asked for it.
        observation: what the planner saw, ``[N]``.
        heights: int32 ``[N, W_T, D_T]``.
        item: the item in each bin.
        action: int64 ``[N]``.
    """
    tote_height = observation["tote_height"].reshape(-1)
    step = rules.apply(heights, tote_height, item, action)
    x_bin, y_bin, x_tote, y_tote, rotation = (part.tolist() for part in rules.split_action(action))
    heat = planner.heat_map(observation) if hasattr(planner, "heat_map") else None
    if heat is not None:
        heat = (255 * heat / heat.amax((1, 2), keepdim=True).clamp(min=1e-30)).round().byte().cpu().numpy()
    ee_w, ee_d = rules.effector_size
    items = torch.stack(item, -1).tolist()
    moves = []
    for row in range(len(action)):
        _, _, ref_x, ref_y = rules.effectors[rotation[row] % 2]
        moves.append(
            Move(
                item=tuple(items[row]),
                pick=(x_bin[row] - (ee_w - 1) // 2, y_bin[row] - (ee_d - 1) // 2),
                place=(x_tote[row] - ref_x, y_tote[row] - ref_y),
                rotation=rotation[row],
                footprint=tuple(step.footprint[row].tolist()),
                z=int(step.top[row]) - items[row][4],
                failure=Failure(int(step.failure[row])),
                heat=None if heat is None else heat[row],
            )
        )
    return moves


# ---------------------------------------------------------------------- the page
def page(recordings: list[Recording], rules: Rules, title: str) -> str:
    """A self-contained HTML page that replays episodes in 3D; it asks nothing of any network.

    Args:
        recordings: at least one episode.
        rules: the task's sizes.
        title: a short line, such as the planner's name and the stream.
    """
    colours = item_colours([box for recording in recordings for box in recording.boxes + _others(recording)])
    data = {
        "title": title,
        "bin": rules.bin_size,
        "tote": rules.tote_size,
        "effector": rules.effector_size,
        "colours": {",".join(map(str, kind)): colour for kind, colour in colours.items()},
        "episodes": [_episode(recording, rules) for recording in recordings],
    }
    packed = base64.b64encode(zlib.compress(json.dumps(data, separators=(",", ":")).encode(), 9)).decode()
    html = (ASSETS / "replay.html").read_text(encoding="utf-8")
    parts = {"title": escape(title), "data": packed, "three": _three()}
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], html)


@cache
def _three() -> str:
    return (ASSETS / "three.min.js").read_text(encoding="utf-8").replace("</script", "<\\/script")


def _others(recording: Recording) -> list[tuple[int, ...]]:
    """Items that are seen but not placed, as boxes."""
    items = [move.item for move in recording.moves if move.failure]
    items += [recording.waiting] if recording.waiting else []
    return [(0, 0, 0, *item[2:]) for item in items]


def _episode(recording: Recording, rules: Rules) -> dict:
    heat = [move.heat for move in recording.moves if move.heat is not None]
    ending = recording.describe_ending(rules.num_places)
    return {
        "episode": recording.episode,
        "height": recording.tote_height,
        "occupancy": recording.occupancy,
        "ending": ending,
        "briefly": "full" if ending == FULL else BRIEFLY[recording.ending],
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
def picture(recording: Recording, rules: Rules, path: Path, moves: int | None = None) -> None:
    """Draw the tote after a number of moves, beside its height map, as PNG or SVG.

    Args:
        moves: how many moves have been made; None: all.
    """
    colours = item_colours(recording.boxes)
    draw_scene(recording, rules, colours, moves).savefig(path, dpi=120)


def animation(recording: Recording, rules: Rules, path: Path, seconds: float = 12.0, frames: int = 120) -> None:
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
        draw_scene(recording, rules, colours, moves).savefig(buffer, format="png", dpi=60)
        images.append(Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE))
    each = max(20, round(1000 * seconds / len(images)))
    durations = [each] * (len(images) - 1) + [each + 2000]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
