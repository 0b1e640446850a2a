"""A stability rule of your own: three supported corners, or 60% of the footprint with the centre inside the hull."""

from dataclasses import dataclass

from pickplace.rules.support.base import Support


@dataclass(frozen=True)
class CornersOrHull(Support):
    """Some corners of the footprint are supported; or a share of it, and its centre is inside the hull of the support.

    Args:
        corners: number of supported corners that suffices, 1 to 4.
        share: share of the footprint that suffices with the centre inside the hull, 0 to 1.
    """

    corners: int = 3
    share: float = 0.6

    def stable(self, contact):
        """Return whether items on the grid are stable, bool of the shape of ``contact.z``."""
        enough = (contact.share >= self.share) & contact.is_centre_in_hull()
        return (contact.num_supported_corners >= self.corners) | enough

    def measured(self, patches):
        """Return whether items in metres are stable; pickplace adds that the centre is inside the hull."""
        return patches.share >= self.share
