"""Measured boxes, and the defaults of a measurement. Imports no torch, so that ``--help`` does not wait for it."""

import math
from dataclasses import dataclass, replace

MILLIMETRE = 1e-3  # height unit of measured maps, m
ACCURACY = 0.003  # default of the greatest error of a measured height, m
CLEARANCE = 0.005  # default of the least distance between an item and its neighbours, m


class DepthMapError(ValueError):
    """Error of a depth map, or of an argument beside it, that allows no plan; the message is one sentence."""


class EmptyBinError(DepthMapError):
    """No item lies in the bin: there is nothing to plan until one arrives."""


@dataclass(frozen=True)
class Box:
    """A measured cuboid that stands in the bin; in metres and degrees, in the bin's frame."""

    x: float  #: of its centre
    y: float  #: of its centre
    w: float  #: side along x, before it is turned by the yaw
    d: float  #: side along y
    h: float  #: height of its top above the bin's floor
    yaw: float = 0.0  #: turn about the vertical axis, counter-clockwise seen from above
    edge_error: float = 0.0  #: greatest distance by which a side may lie inside the measured ``w`` or ``d``
    mass: float = 0.0  #: kg; 0: not known: the box may lie only on items that bear any load
    max_load: float | None = None  #: greatest mass on top of it, kg; 0: nothing may lie on it; None: any

    def __post_init__(self):
        for name, value in [*vars(self).items()]:
            if getattr(value, "shape", None) == ():  # a numpy number, which JSON does not hold
                object.__setattr__(self, name, value.item())

    def upright(self) -> "Box":
        """Return the same cuboid with a yaw above -45 and at most 45 degrees."""
        quarters = math.ceil(self.yaw / 90 - 0.5 - 1e-9)
        w, d = (self.d, self.w) if quarters % 2 else (self.w, self.d)
        return replace(self, w=w, d=d, yaw=self.yaw - 90 * quarters)


@dataclass(frozen=True)
class HiddenBox(Box):
    """A box that a higher one may hide in part: an obstacle, which is not picked."""


@dataclass(frozen=True)
class UnknownBox(HiddenBox):
    """A place in the bin that an image does not show well enough: an obstacle of the greatest possible size."""
