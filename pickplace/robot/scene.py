"""A scene: the measured contents of the bin and the tote, and the accuracy of the measurement."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from pickplace.common.validate import (
    excerpt,
    integral_number,
    is_number,
    number,
    one_of,
    or_null,
    refuse_above,
    refuse_if,
)
from pickplace.robot.box import ACCURACY, CLEARANCE, MILLIMETRE, Box, DepthMapError, EmptyBinError, UnknownBox
from pickplace.robot.camera import Camera
from pickplace.robot.measure import ToteMap
from pickplace.rules.cell import MAX_BIN_ITEMS, MAX_SIDE, CellSpec
from pickplace.rules.maps import FAR

CLEARANCE_PIXELS = 2  # least clearance around an item that a camera sees, in pixels
MAX_VALUE = 1e3  # greatest coordinate of a box, m, its greatest yaw, degrees, and mass, kg
#: Least values of a box's fields: lengths in metres, masses in kilograms.
MIN_FIELD_VALUES = {
    **dict.fromkeys("wdh", (MILLIMETRE, "a length", "m")), "edge_error": (0.0, "a length", "m"),
    "mass": (0.0, "a mass", "kg"), "max_load": (0.0, "a mass", "kg"),
}  # fmt: skip


class BinMap(NamedTuple):
    """Heights above the bin's floor, ``[W_B, D_B]`` or a whole multiple of it, 0 where it is empty."""

    depth: Any  #: numpy, torch or lists
    #: for several items, whole numbers in the same shape: 0 where the bin is empty, another number for each item; None:
    #: one item lies there
    labels: Any = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Measured contents of the bin and the tote, for :meth:`~pickplace.robot.planner.Planner.plan`.

    With ``cell_size`` all lengths are in metres. Without it maps and ``tote_height`` are whole numbers of height units,
    as in training.

    Raises:
        ValueError: for a setting that is missing or out of range.
        EmptyBinError: for no items.
        DepthMapError: for items that are no boxes, or too many. The planner checks what depends on its cell.
    """

    #: everything that lies in the bin: boxes in metres, or a map, see :meth:`from_maps`
    items: Sequence[Box] | BinMap
    #: ``[W_T, D_T]``, or a whole multiple of it: remaining height, from the surface up to the rim; numpy, torch or
    #: lists. With one value a cell, each is the least that was measured in the cell. Or a `ToteMap`
    tote: Any
    cell_size: float | None = None  #: side of a cell, m; None: maps of whole cells
    accuracy: float = ACCURACY  #: greatest error of a measured height, m
    clearance: float = CLEARANCE  #: least distance that an item keeps from what stands beside it, on each side; m
    #: greatest distance between an item and its planned place, in any direction, at most ``clearance``; m; None: the
    #: clearance. A support counts only if it carries the item at all these places
    placement_error: float | None = None
    #: the place whose height each value of a tote's map in metres gives, to within ``accuracy``: ``"area"``, the
    #: highest of its square; or ``"centre"``, the point in its middle
    tote_samples: str = "area"
    tote_height: float | None = None  #: height of the tote's rim above its floor; None: from ``cell.tote_size``
    #: with ``support="bearing"``, ``[W_T, D_T]``, 1 where a cell bears weight, else 0: ``tote_bearing`` of the plan
    #: before; None: every cell bears weight. For a map in metres with one value a cell, None means that only the floor
    #: does, as such a map does not tell whether a cell is level
    tote_bearing: Any = None
    bin_height: float | None = None  #: height of the bin's walls above its floor; None: from ``cell.bin_size``
    #: everything that lies in the tote: :attr:`Plan.placed` of each plan that was carried out; None: not known. Needed
    #: if a box has a ``max_load``; for scenes in metres only
    placed: Sequence[Box] | None = None
    #: the items that arrive next, in their order, each as it will lie in the bin; None: not known. They do not change
    #: what is feasible; ``afterstate``, ``afterstate_fcn`` and searches plan with them. For scenes in metres only
    coming: Sequence[Box] | None = None

    def __post_init__(self):
        number("accuracy", self.accuracy, 0, 0.1, "metres")
        number("clearance", self.clearance, 0, 0.1, "metres")
        one_of("tote_samples", self.tote_samples, ("area", "centre"))
        if self.placement_error is not None:
            number("placement_error", self.placement_error, 0, 0.1, "metres")
            refuse_if(
                self.placement_error > self.clearance,
                f"placement_error={self.placement_error:g}: expected at most clearance={self.clearance:g} m, which the "
                "item keeps from what stands beside it.",
            )
        if self.cell_size is not None:
            number("cell_size", self.cell_size, 1e-3, 10, "metres")
        elif not isinstance(self.items, BinMap) or isinstance(self.tote, ToteMap):
            raise ValueError("cell_size=None: expected the side of a cell in metres, as items or tote are measured.")
        for key in ("tote_height", "bin_height"):
            if (height := getattr(self, key)) is not None and self.cell_size is not None:
                number(key, height, MILLIMETRE, MAX_SIDE * MILLIMETRE, "metres")
            elif height is not None:
                integral_number(key, height, 1, FAR - 1)
        if self.placed is not None:
            refuse_if(self.cell_size is None, "placed: the lengths are whole cells; expected a scene in metres.")
            _check_boxes("placed", self.placed)
        if self.coming is not None:
            refuse_if(self.cell_size is None, "coming: the lengths are whole cells; expected a scene in metres.")
            _check_boxes("coming", self.coming)
            refuse_above("coming: the list has", len(self.coming), "boxes", MAX_BIN_ITEMS)
        if isinstance(self.items, BinMap):
            return
        _check_boxes("items", self.items)
        refuse_if(
            not 1 <= len(self.items) <= MAX_BIN_ITEMS,
            f"items: got {len(self.items)} boxes, expected 1 to {MAX_BIN_ITEMS}: "
            f"{'too many' if self.items else 'an empty bin'}.",
            DepthMapError if self.items else EmptyBinError,
        )

    @classmethod
    def from_maps(cls, bin_depth, tote_depth, bin_labels=None, **settings) -> "Scene":
        """Return the scene of two maps, in whole cells or in metres.

        Args:
            bin_depth, bin_labels: see :class:`BinMap`.
            tote_depth: see :attr:`tote`.
            **settings: the other fields.
        """
        return cls(BinMap(bin_depth, bin_labels), tote_depth, **settings)

    @classmethod
    def from_images(
        cls, cell: CellSpec, bin_view: tuple[Camera, Any], tote_view: tuple[Camera, Any], cell_size: float,
        accuracy: float = ACCURACY, labels=None, sizes=None, tote_height: float | None = None,
        greatest_height: float | None = None, placed: Sequence[Box] = (), bin_height: float | None = None, **settings,
    ) -> "Scene":  # fmt: skip
        """Return the scene that two cameras see.

        Args:
            cell: the sizes.
            bin_view, tote_view: a camera above each, and its depth image. One camera may see both: give it twice, with
                a pose for each.
            labels, sizes: of the items, see :meth:`~pickplace.robot.camera.Camera.items`, also for errors.
            greatest_height: of an item, m; None: the height of the tote's rim.
            placed: the items that lie in the tote, see :meth:`~pickplace.robot.camera.Camera.tote_map`.
            **settings: the other fields.

        Raises:
            ValueError: for a ``clearance`` below two pixels: an edge is not seen more exactly.
            EmptyBinError: if the bin is seen, and nothing lies in it.
            DepthMapError: for an image that allows no plan; another image may do.
        """
        (over_bin, bin_image), (over_tote, tote_image) = bin_view, tote_view
        pixel, clearance = max(over_bin.pixel(), over_tote.pixel()), settings.get("clearance", CLEARANCE)
        number("clearance", clearance, 0, 0.1, "metres")
        number("accuracy", accuracy, 0, 0.1, "metres")
        number("cell_size", cell_size, 1e-3, 10, "metres")
        heights = {"tote_height": tote_height, "bin_height": bin_height, "greatest_height": greatest_height}
        for key, height in heights.items():
            or_null(number, key, height, MILLIMETRE, MAX_SIDE * MILLIMETRE, "metres")
        refuse_if(
            clearance < CLEARANCE_PIXELS * pixel - 1e-9,
            f"clearance={clearance:g}: a pixel shows {pixel:.4f} m of the floor; expected at least {CLEARANCE_PIXELS} "
            f"pixels, {CLEARANCE_PIXELS * pixel:.4f} m, or a camera that is nearer or has more pixels.",
        )
        greatest = tote_height if greatest_height is None else greatest_height
        return cls(
            over_bin.items(bin_image, cell, cell_size, labels, accuracy, sizes, greatest, bin_height),
            over_tote.tote_map(tote_image, cell, cell_size, tote_height, accuracy, placed),
            cell_size, accuracy, tote_height=tote_height, bin_height=bin_height, placed=placed, **settings,
        )  # fmt: skip

    @property
    def has_holes(self) -> bool:
        """Whether images left unknown places in the bin or the tote."""
        boxes = () if isinstance(self.items, BinMap) else self.items
        return any(isinstance(box, UnknownBox) for box in boxes) or (
            isinstance(self.tote, ToteMap) and self.tote.has_holes
        )

    def without_gaps(self) -> "Scene | None":
        """Return the likely scene if images have narrow gaps, such as at edges; None if they have none."""
        likely = self.tote.likely if isinstance(self.tote, ToteMap) else None
        boxes = () if isinstance(self.items, BinMap) else self.items
        if likely is None and not any(box.edge_error for box in boxes):
            return None
        narrower = []
        for box in boxes:
            w, d = (max(side - 2 * box.edge_error, MILLIMETRE) for side in (box.w, box.d))
            narrower.append(replace(box, w=w, d=d, edge_error=0.0))
        return replace(self, items=narrower if boxes else self.items, tote=likely or self.tote)


def _check_boxes(key: str, boxes: Any) -> None:
    """Refuse anything but a list of boxes with numbers in range; ``key`` is the field of the scene."""
    refuse_if(
        not isinstance(boxes, (list, tuple)) or not all(isinstance(box, Box) for box in boxes),
        f"{key}={excerpt(boxes)}: expected a list of Box.",
        DepthMapError,
    )
    for at, box in enumerate(boxes):
        for name in (field.name for field in fields(Box)):
            value, (least, what, unit) = getattr(box, name), MIN_FIELD_VALUES.get(name, (-MAX_VALUE, "", ""))
            expected = f"{what} from {least:g} to {MAX_VALUE:g} {unit}" if unit else f"-{MAX_VALUE:g} to {MAX_VALUE:g}"
            good = is_number(value) and least <= value <= MAX_VALUE or (name == "max_load" and value is None)
            refuse_if(not good, f"{key}[{at}].{name}={excerpt(value)}: expected {expected}.", DepthMapError)
