"""A request for a plan: a line of ``pickplace-plan``, or the body of an HTTP request. All keys are defined here."""

import json
import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, NamedTuple

from typing_extensions import Self

from pickplace.common.errors import sentence
from pickplace.common.validate import expect, number, refuse_above, refuse_any, refuse_if, reword_errors, unique_keys
from pickplace.robot.box import ACCURACY, CLEARANCE, Box, EmptyBinError
from pickplace.serve.deadline import Deadline

if TYPE_CHECKING:
    from pickplace.robot.planner import Plan, Planner
    from pickplace.robot.scene import Scene
    from pickplace.rules.cell import CellSpec

MAX_DIGITS = 300  # of a whole number; a float holds no more
MAX_NESTED = 100  # lists and objects in an id
MAX_REQUEST = 2**24  # greatest length of a request, in bytes, whatever the cell
DEADLINE, MAX_DEADLINE = 10.0, 3600.0  # default and greatest time until an answer, in seconds

Map = list[list[float]]
Labels = list[list[int]]


@dataclass(frozen=True)
class RequestLimits:
    """Limits of a request for a cell: its maps, each with :data:`FINE` values along a cell, and some more."""

    size: int  # in bytes
    lists: int  # number of lists: each costs as much to read as a row of a map

    FINE = 64  # pixels of 2 mm in a cell of 128 mm
    VALUE = 8  # bytes of a value, such as 0.1234 with a comma and a space
    REST = 2**16  # bytes of everything but maps, such as boxes
    OTHERS = 1_000  # number of lists that are not rows of maps

    @classmethod
    def of(cls, cell: "CellSpec") -> Self:
        (bin_w, bin_d, _), (tote_w, tote_d, _) = cell.bin_size, cell.tote_size
        values = cls.FINE**2 * (2 * bin_w * bin_d + tote_w * tote_d) + tote_w * tote_d  # labels and bearing, too
        rows = cls.FINE * (2 * bin_w + tote_w) + tote_w
        return cls(min(MAX_REQUEST, cls.REST + cls.VALUE * values), cls.OTHERS + rows)

    def check(self, text: bytes) -> None:
        """Refuse, with a ``ValueError``, a text with too many bytes or lists for the cell, before it is parsed."""
        refuse_if(len(text) > self.size, f"the request has more than {self.size:,} bytes; expected a shorter one.")
        refuse_above("the request has", text.count(b"["), "lists, rows of maps included", self.lists)


def _key(description: str, default: Any = None, option: type | None = None) -> Any:
    """Define a key of a request; with ``option``, a type, the command line can set it for all requests."""
    return field(default=default, metadata={"description": description, "option": option})


@dataclass(frozen=True)
class PlanRequest:
    """A bin and a tote; in metres with ``cell_size``, else in whole cells and height units.

    The bin and the tote have a frame each: its origin is the outer corner of cell (0, 0) on the inner floor, x runs
    along the first axis of a map, y along the second, z upwards.
    """

    id: object = _key("comes back as it is")
    bin_depth: Map | None = _key(
        "height above the bin's floor, 0 where it is empty, [W_B, D_B] or a multiple of it; m with cell_size, else "
        "height units"
    )
    bin_labels: Labels | None = _key("a number for each of several items, 0 elsewhere; in the shape of bin_depth")
    items: list[Box] | None = _key("instead of bin_depth: the measured items, in the bin's frame; m and degrees")
    tote_depth: Map | None = _key(
        "height left from the surface up to the rim, [W_T, D_T] or a multiple of it; m with cell_size, else height "
        "units"
    )
    tote_bearing: Labels | None = _key("tote_bearing of the plan before, [W_T, D_T]: 1 where a cell bears weight")
    placed: list[Box] | None = _key(
        "what lies in the tote, as the plans before placed it, in the tote's frame, h the height of its top; m and "
        "degrees; needed where a box has a max_load"
    )
    coming: list[Box] | None = _key(
        "the items that arrive next, in their order, each as it will lie in the bin, as in items; m and degrees"
    )
    exclude: list[list[float]] | None = _key(
        "pick.center of plans whose grasp failed, in the bin's frame: no pick within half a cell of one is planned "
        "again; m with cell_size, else cells"
    )
    tote_height: float | None = _key(
        "height of the rim above the tote's floor; m with cell_size, else height units; default: that of the cell",
        None, float,
    )  # fmt: skip
    bin_height: float | None = _key(
        "height of the walls above the bin's floor; m with cell_size, else height units; default: that of the cell",
        None, float,
    )  # fmt: skip
    cell_size: float | None = _key("side of a cell, if the lengths are in metres; m", None, float)
    accuracy: float = _key("greatest error of a measured height; m", ACCURACY, float)
    clearance: float = _key("least distance from what stands beside the item; m", CLEARANCE, float)
    placement_error: float | None = _key(
        "greatest distance of an item from where it is set down; m; default: the clearance", None, float
    )
    tote_samples: str = _key(
        "what a value of tote_depth in metres holds for: area, the highest of its square; centre, its middle",
        "area",
        str,
    )
    alternatives: int = _key("number of most probable choices reported", 10, int)
    deadline: float = _key("greatest time until the answer, waiting included; s", DEADLINE, float)

    @classmethod
    def parse(cls, given: dict, defaults: dict) -> Self:
        """Return the request that an object in JSON states.

        Args:
            given: its keys and values; a null counts as a missing key.
            defaults: values of missing keys.

        Raises:
            ValueError: naming the first key that is unknown or missing, or the first box with other keys.
        """
        known = [key.name for key in fields(cls)]
        refuse_any(
            sorted(set(given) - set(known)),
            lambda key: f"{key[:40]}: there is no such key; expected any of {', '.join(known)}.",
        )
        given = {key: value for key, value in given.items() if value is not None}
        for key in ("items", "placed", "coming"):
            if key in given:
                given[key] = read_boxes(key, given[key])
        if "items" in given:
            refuse_any(
                (key for key in ("bin_depth", "bin_labels") if key in given),
                lambda key: f"{key}, items: got both, expected one of the two.",
            )
        for key in ("tote_depth",) if "items" in given else ("bin_depth", "tote_depth"):
            refuse_if(key not in given, f"{key}: missing; expected a depth map as a list of rows.")
        request = cls(**{**defaults, **given})
        number("deadline", request.deadline, 0.001, MAX_DEADLINE, "seconds")
        return request

    def scene(self) -> "Scene":
        """Return the scene that the request describes.

        Raises:
            ValueError: see :class:`~pickplace.robot.scene.Scene`.
        """
        from pickplace.robot.scene import BinMap, Scene  # here, so that --help does not wait for torch

        settings = {key.name: getattr(self, key.name) for key in fields(Scene) if key.name not in ("items", "tote")}
        items = BinMap(self.bin_depth, self.bin_labels) if self.items is None else self.items
        return Scene(items, self.tote_depth, **settings)

    def plan(self, planner: "Planner") -> "Plan":
        """Return the plan for the request; see :meth:`Planner.plan` for errors."""
        return planner.plan(
            self.scene(), alternatives=self.alternatives, exclude=() if self.exclude is None else self.exclude
        )


#: Fields that the command line can set for all requests.
PLAN_OPTIONS = [key for key in fields(PlanRequest) if key.metadata["option"]]


def read_boxes(key: str, items) -> list[Box]:
    """Return the boxes of a request's ``items``, ``placed`` or ``coming``.

    Raises:
        ValueError: if it is no list; or naming the first box with other keys.
    """
    boxes = []
    for at, item in enumerate(expect(isinstance(items, list), key, items, "a list of boxes")):
        try:
            boxes.append(Box(**item))
        except TypeError as error:
            raise ValueError(f"{key}[{at}]: expected the keys x, y, w, d, h and any of yaw, mass, max_load.") from error
    return boxes


def parse_json(text: bytes) -> dict:
    """Return the object in a request's text; its keys are not checked.

    Raises:
        ValueError: for a text that is no object in JSON, or has a key twice.
    """
    with reword_errors(
        (json.JSONDecodeError, UnicodeDecodeError, RecursionError),
        lambda error: ValueError(f"the request is not JSON: {error}."),
    ):
        given = json.loads(
            text.decode(), parse_constant=finite_float, parse_float=finite_float, parse_int=short_int,
            object_pairs_hook=unique_keys,
        )  # fmt: skip
    refuse_if(
        not isinstance(given, dict), f"got {type(given).__name__}, expected an object with bin_depth and tote_depth."
    )
    return given


def finite_float(text: str) -> float:
    """Return a number of a JSON text; refuse NaN, Infinity and 1e999, which Python accepts."""
    if math.isfinite(value := float(text)):
        return value
    raise ValueError(f"the request is not JSON: got {text[:20]}, expected a finite number.")


def short_int(text: str) -> int:
    """Return a whole number of a JSON text; refuse one with so many digits that Python does not read it."""
    if len(text) <= MAX_DIGITS:
        return int(text)
    raise ValueError(f"the request is not JSON: got {text[:20]}..., expected at most {MAX_DIGITS} digits.")


def read_request(text: bytes, limits: RequestLimits, defaults: dict) -> tuple[int, dict, PlanRequest | None]:
    """Return the HTTP status 200, the beginning of the reply with the ``id``, and the request that a text states.

    For a bad request: the HTTP status, ``{"error": ...}`` in one sentence, and None.
    """
    status, reply = 400, {}
    try:
        limits.check(text)
        given = parse_json(text)
        nested = sum(json.dumps(given.get("id")).count(bracket) for bracket in "[{")
        refuse_if(nested > MAX_NESTED, f"id: it holds {nested} lists and objects, expected at most {MAX_NESTED}.")
        status, reply = 422, {key: given[key] for key in ("id",) if key in given}
        return 200, reply, PlanRequest.parse(given, defaults)
    except ValueError as error:
        return status, {**reply, "error": sentence(error)}, None


class Answer(NamedTuple):
    """An answer to a request."""

    status: int  # HTTP status
    reply: dict  # a plan, or ``{"error": ...}`` in one sentence; with the request's ``id``
    text: str  # the reply as JSON


def solve(planner: "Planner", request: PlanRequest, reply: dict, deadline: Deadline) -> Answer:
    """Return the answer to a request: the beginning of its ``reply``, completed by a plan or an error."""
    try:
        reply = {**reply, **deadline.run(lambda: request.plan(planner)).as_dict()}
        return Answer(200, reply, to_json(reply))
    except (ValueError, TimeoutError, FloatingPointError) as error:
        status = 422 if isinstance(error, ValueError) else 504 if isinstance(error, TimeoutError) else 500
        reply = {**{key: reply[key] for key in ("id",) if key in reply}, "error": sentence(error)}
        reply |= {"empty_bin": True} if isinstance(error, EmptyBinError) else {}
        return Answer(status, reply, json.dumps(reply))


def to_json(reply: dict, **settings) -> str:
    """Return a plan as JSON.

    Raises:
        FloatingPointError: for a number that is not finite, which comes only from weights that no training made.
    """
    with reword_errors(
        ValueError,
        lambda _: FloatingPointError("the plan has a number that is not finite; expected another checkpoint."),
    ):
        return json.dumps(reply, allow_nan=False, **settings)


def answer(planner: "Planner", text: bytes, defaults: dict) -> Answer:
    """Return the answer to a line of ``pickplace-plan``."""
    status, reply, request = read_request(text, RequestLimits.of(planner.cell), defaults)
    if request is None:
        return Answer(status, reply, json.dumps(reply))
    return solve(planner, request, reply, Deadline(request.deadline))
