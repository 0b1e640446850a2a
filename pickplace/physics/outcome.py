"""The end of an episode that was carried out."""

from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from pickplace.views.motion import Motion


class Loss(NamedTuple):
    """The first loss of an episode: its reason, and the number of the lost item, from 0."""

    reason: str
    item: int


@dataclass(frozen=True)
class Outcome:
    """The end of an episode that was carried out."""

    episode: int
    ending: str  # "done", or the reason of the first loss
    lost: int | None  # number of the lost item, from 0
    during: int | None  # number of the placement during which it was lost; the number of placements: at the end
    placed: int  # items placed before the loss
    occupancy: float  # share of the tote that they fill
    drift: float  # greatest distance of a placed item that was not lost from its planned pose, m
    cpu_seconds: float
    motion: Motion | None = field(default=None, repr=False)  # of an episode that was to be recorded

    def facts(self) -> dict[str, Any]:
        """Return all but the motion, as ``pickplace-physics`` prints it."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "motion"}
