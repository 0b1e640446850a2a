"""The stability rules that have a short name, one class each, and the short form that names them."""

from dataclasses import dataclass, field
from math import nextafter
from typing import Any

from torch import Tensor

from pickplace.common.validate import is_number, number, one_of
from pickplace.rules.support.base import Support
from pickplace.rules.support.contact import Contact, Patches
from pickplace.rules.support.pct import Pct


@dataclass(frozen=True)
class Share(Support):
    """At least a share of the footprint is supported.

    Args:
        least: the share, 0 to 1.
    """

    least: float

    def __post_init__(self):
        number("support.least", self.least, 0, 1)

    def stable(self, contact: Contact) -> Tensor:
        return contact.share >= self.least

    def measured(self, patches: Patches) -> Tensor:
        return patches.share >= self.least


@dataclass(frozen=True)
class Half(Share):
    """At least half of the footprint is supported: the paper's rule."""

    least: float = field(default=0.5, init=False)


@dataclass(frozen=True)
class MoreThanHalf(Share):
    """More than half of the footprint is supported."""

    least: float = field(default=nextafter(0.5, 1), init=False)  # the next number after a half


@dataclass(frozen=True)
class Full(Share):
    """The whole footprint is supported."""

    least: float = field(default=1.0, init=False)


@dataclass(frozen=True)
class HalfOrHull(MoreThanHalf):
    """More than half is supported, or the centre is in the hull of the middles of the supporting cells or on its edge.

    A measured surface has no cells; there the share decides alone.
    """

    def stable(self, contact: Contact) -> Tensor:
        return super().stable(contact) | contact.is_centre_in_hull_of_middles()


@dataclass(frozen=True)
class Corners(Share):
    """60% of the footprint and its four corners are supported, or 80% and three corners, or 95%.

    On a measured surface the 95% are needed.
    """

    least: float = field(default=0.95, init=False)

    def stable(self, contact: Contact) -> Tensor:
        corners, share = contact.num_supported_corners, contact.share
        return super().stable(contact) | ((corners >= 4) & (share >= 0.6)) | ((corners >= 3) & (share >= 0.8))


@dataclass(frozen=True)
class Cdrl(Share):
    """More than half of the footprint and its four corners are supported, or over 85% and three, or over 95%.

    From the code of Zhao et al., 2021, "Online 3D Bin Packing with Constrained Deep Reinforcement Learning", which
    differs from their text. With over 95% three corners must be equally high, and no lower than the fourth. On a
    measured surface over 95% are needed.
    """

    least: float = field(default=nextafter(0.95, 1), init=False)  # the next number after 0.95

    def stable(self, contact: Contact) -> Tensor:
        corners, share = contact.num_supported_corners, contact.share
        # If over 95% of up to 40 cells are supported, so is some corner: the highest corners are supported ones.
        level = corners if contact.side <= 6 else contact.num_level_corners
        found = super().stable(contact) & (level >= 3)
        return found | ((corners >= 4) & (share > 0.5)) | ((corners >= 3) & (share > 0.85))


@dataclass(frozen=True)
class Gopt(MoreThanHalf):
    """:class:`HalfOrHull`, but the hull needs two supporting cells, and the centre may not be on its edge of least y.

    From the code of GOPT (Xiong et al., 2024). A centre on that edge counts if the middles are all on a line. A
    measured surface has no cells; there the share decides alone.
    """

    def stable(self, contact: Contact) -> Tensor:
        within = contact.is_centre_in_hull_of_middles() & ~contact.is_centre_on_near_edge()
        return super().stable(contact) | (within & (contact.count > 1))


@dataclass(frozen=True)
class Hull(Support):
    """The item's centre lies inside the convex hull of the supporting cells.

    Args:
        margin: distance from the hull's edge that the centre must exceed, in cells, 0 to 100.
    """

    margin: float = 0.25

    def __post_init__(self):
        number("support.margin", self.margin, 0, 100)

    def stable(self, contact: Contact) -> Tensor:
        return contact.is_centre_in_hull(self.margin)

    def measured(self, patches: Patches) -> Tensor:
        return patches.is_centre_in_hull(self.margin)


@dataclass(frozen=True)
class Bearing(Hull):
    """The rule :class:`Hull`; the top of an item bears weight only above the hull of its supporting cells.

    Whatever is put on it then presses inside that hull, down to the floor. So no item tips the pile below it.
    """

    def bearing(self, contact: Contact) -> Tensor:
        return contact.hull_mask()


@dataclass(frozen=True)
class RoundedUp(Bearing):
    """The rule :class:`Bearing` for items that may be up to a cell smaller than the cells that they take.

    The difference is at the far ends. Cells there must bear nothing if the item does not fill them. Then an item whose
    four corners are supported cannot tip. Any other item needs the margin: along each axis, its centre is up to half a
    cell off the middle of its cells.
    """

    def stable(self, contact: Contact) -> Tensor:
        return super().stable(contact) | (contact.num_supported_corners >= 4)


#: The rules that a short form names; a number is the least share.
RULES: dict[str, type[Support]] = {
    "half": Half,
    "more_than_half": MoreThanHalf,
    "hull": Hull,
    "bearing": Bearing,
    "half_or_hull": HalfOrHull,
    "corners": Corners,
    "cdrl": Cdrl,
    "gopt": Gopt,
    "full": Full,
    "pct": Pct,
}


def read_support(value: Any) -> Support:
    """Return a stability rule unchanged, or the rule of a short form: a name, or the least share of :class:`Share`.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(value, Support):
        return value
    if is_number(value) and 0 <= value <= 1:
        return Share(value)
    return RULES[one_of("support", value, RULES, "a number between 0 and 1, or an object of a rule's class")]()
