"""A request for a plan: a line of ``pickplace-plan``, or the body of an HTTP request. Each key is stated here, once."""

import json
import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Self

from pickplace.common.errors import sentence
from pickplace.common.validate import refuse_any, refuse_if, reworded
from pickplace.robot.box import ACCURACY, CLEARANCE, Box

if TYPE_CHECKING:
    from pickplace.robot.planner import Plan, Planner
    from pickplace.robot.scene import Scene

MAX_REQUEST = 2**24  # greatest length of a request, in bytes

Map = list[list[float]]
Labels = list[list[int]]


def _key(description: str, default: Any = None, option: type | None = None) -> Any:
    """Return a key of a request; with ``option``, a type, the command line can set it for all requests."""
    return field(default=default, metadata={"description": description, "option": option})


@dataclass(frozen=True)
class PlanRequest:
    """A bin and a tote; without ``cell_size`` in whole cells, else in metres."""

    id: object = _key("comes back as it is")
    bin_depth: Map | None = _key("height above the bin's floor, [W_B, D_B] or a multiple of it")
    bin_labels: Labels | None = _key("a number for each of several items, 0 elsewhere")
    items: list[Box] | None = _key("instead of bin_depth: the measured items, in metres")
    tote_depth: Map | None = _key("height left up to the rim, [W_T, D_T] or a multiple of it")
    tote_bearing: Labels | None = _key("tote_bearing of the plan before")
    tote_height: float | None = _key("height of the rim above the tote's floor; default: that of the cell", None, float)
    cell_size: float | None = _key("side of a cell in metres, if the maps are in metres", None, float)
    accuracy: float = _key("greatest error of a measured height, in metres", ACCURACY, float)
    clearance: float = _key("least distance from what stands beside the item, in metres", CLEARANCE, float)
    placement_error: float | None = _key(
        "greatest distance of an item from where it is set down, in metres; default: the clearance", None, float
    )
    tote_samples: str = _key(
        "what a value of tote_depth in metres holds for: area, all of its square; centre, its middle", "area", str
    )
    alternatives: int = _key("number of most probable choices reported", 10, int)

    @classmethod
    def parse(cls, given: dict, defaults: dict) -> Self:
        """Return the request that an object in JSON states.

        Args:
            given: its keys and values; a null is as good as no key.
            defaults: values of keys that it does not have.

        Raises:
            ValueError: naming the first key that is unknown or missing, or the first box with other keys.
        """
        known = [key.name for key in fields(cls)]
        refuse_any(
            sorted(set(given) - set(known)),
            lambda key: f"{key[:40]}: there is no such key; expected any of {', '.join(known)}.",
        )
        given = {key: value for key, value in given.items() if value is not None}
        if "items" in given:
            given["items"] = read_boxes(given["items"])
            refuse_any(
                (key for key in ("bin_depth", "bin_labels") if key in given),
                lambda key: f"{key}, items: got both, expected one of the two.",
            )
        for key in ("tote_depth",) if "items" in given else ("bin_depth", "tote_depth"):
            refuse_if(key not in given, f"{key}: missing; expected a depth map as a list of rows.")
        return cls(**{**defaults, **given})

    def scene(self) -> "Scene":
        """Return the scene that the request describes.

        Raises:
            ValueError: as of :class:`~pickplace.robot.scene.Scene`.
        """
        from pickplace.robot.scene import BinMap, Scene  # here, so that --help need not wait for torch

        settings = {key.name: getattr(self, key.name) for key in fields(Scene) if key.name not in ("items", "tote")}
        items = BinMap(self.bin_depth, self.bin_labels) if self.items is None else self.items
        return Scene(items, self.tote_depth, **settings)

    def plan(self, planner: "Planner") -> "Plan":
        """Return the plan for the request; errors as of :meth:`Planner.plan`."""
        return planner.plan(self.scene(), alternatives=self.alternatives)


#: Fields that the command line can set for all requests.
PLAN_OPTIONS = [key for key in fields(PlanRequest) if key.metadata["option"]]


def read_boxes(items) -> list[Box]:
    """Return the boxes of a request's ``items``.

    Raises:
        ValueError: naming the first one with other keys.
    """
    boxes = []
    for number, item in enumerate(items if isinstance(items, list) else [items]):
        try:
            boxes.append(Box(**item))
        except TypeError as error:
            raise ValueError(f"items[{number}]: expected the keys x, y, w, d, h and, if it is turned, yaw.") from error
    return boxes


def parse_json(text: bytes) -> dict:
    """Return the object that a request's text holds, whatever its keys.

    Raises:
        ValueError: for a text that is too long, or is no object in JSON.
    """
    refuse_if(len(text) > MAX_REQUEST, f"the request has more than {MAX_REQUEST:,} bytes; expected a shorter one.")
    with reworded(
        (json.JSONDecodeError, UnicodeDecodeError, RecursionError),
        lambda error: ValueError(f"the request is not JSON: {error}."),
    ):
        given = json.loads(text.decode(), parse_constant=finite_float, parse_float=finite_float)
    refuse_if(
        not isinstance(given, dict), f"got {type(given).__name__}, expected an object with bin_depth and tote_depth."
    )
    return given


def finite_float(text: str) -> float:
    """Return a number of a JSON text; refuse NaN, Infinity and 1e999, which Python reads and JSON does not have."""
    if math.isfinite(value := float(text)):
        return value
    raise ValueError(f"the request is not JSON: got {text[:20]}, expected a finite number.")


def answer(planner: "Planner", text: bytes, defaults: dict) -> tuple[int, dict, PlanRequest | None]:
    """Return the reply to a request's text: a plan, or ``{"error": ...}`` in one sentence; with the request's ``id``.

    Returns:
        the status in HTTP, the reply, and the request if it could be read.
    """
    status, reply, request = 400, {}, None
    try:
        given = parse_json(text)
        status, reply = 422, {key: given[key] for key in ("id",) if key in given}
        request = PlanRequest.parse(given, defaults)
        return 200, {**reply, **request.plan(planner).as_dict()}, request
    except ValueError as error:
        return status, {**reply, "error": sentence(error)}, request
