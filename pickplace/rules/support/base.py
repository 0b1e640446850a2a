"""The stability rule of a cell as an object: the base class of all rules."""

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor

from pickplace.rules.support.contact import Contact, Patches


class Support(ABC):
    """A stability rule: whether an item is stable where it rests, and where its top bears weight.

    A subclass is a frozen dataclass, whose fields are the rule's settings.
    """

    #: Whether the rule looks at the items in the tote, ``contact.neighbours``. The environment then records them.
    sees_boxes: ClassVar[bool] = False

    @abstractmethod
    def stable(self, contact: Contact) -> Tensor:
        """Return whether items on the grid are stable where they come to rest, bool of the shape of ``contact.z``."""

    def bearing(self, contact: Contact) -> Tensor:
        """Return a mask of the cells on which an item at rest bears weight, bool ``[S * S, N]``; by default all.

        ``S`` is the side of the square of cells at each footprint's minimum corner.
        """
        return contact.under

    def measured(self, patches: Patches) -> Tensor:
        """Return whether an item is stable on a surface that was measured, bool of the shape of ``patches.share``.

        It decides if some patches under the item support nothing. In addition, the item's centre must be inside the
        hull of what carries it. By default, everything under the item must carry it.
        """
        return patches.full

    @property
    def marks_bearing(self) -> bool:
        """Whether some cells on top of an item may bear no weight."""
        return type(self).bearing is not Support.bearing
