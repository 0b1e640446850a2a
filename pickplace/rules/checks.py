"""The checks of an action, in the order of the rules: one list for the single step, masks and measured totes.

A check reads the facts of one scope: a pick (a :class:`~pickplace.rules.grasps.Grasp`), an item at rest on a footprint,
the end effector over the tote, or a rotation. The single step reads all facts of one action. Masks combine the checks
of each scope for all picks, all footprints, all places of the end effector, and all rotations.
"""

from collections.abc import Callable
from functools import reduce
from itertools import takewhile
from operator import and_
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pickplace.rules.maps import NEVER
from pickplace.rules.state import Failure

#: The scopes. A check of a pick, a footprint or a rotation returns whether it is passed. A check of a place of the end
#: effector returns the least, or the greatest, height of the suction face there, which is the height of the item's top.
#: The facts of a rotation are whether it is allowed.
PICK, FOOTPRINT, LEAST_TOP, GREATEST_TOP, TURN = range(5)
_COMPARE = {LEAST_TOP: torch.ge, GREATEST_TOP: torch.le}
_COMBINE = {PICK: and_, FOOTPRINT: and_, LEAST_TOP: torch.maximum, GREATEST_TOP: torch.minimum, TURN: and_}


class Resting(NamedTuple):
    """Items at rest on footprints."""

    inside: Tensor | None  # whether the footprint is in the tote; None: ``top`` is above any rim where it is not
    top: Tensor  # height of the item's top
    rim: Tensor | int  # height of the tote
    stable: Tensor
    borne: Tensor | None = None  # whether the items below bear the load; None: any item bears any load


class EffectorOverTote(NamedTuple):
    """The end effector over places in the tote."""

    leaves_tote: Tensor  # whether it leaves the tote
    rim: Tensor  # height of the tote
    obstacle: Tensor  # greatest height under it in the tote
    lowest: Tensor | None = None  # limits of the robot on the height of the suction face; None: it has none
    highest: Tensor | None = None

    def at(self, index: Tensor) -> "EffectorOverTote":
        """Return the facts at flat indices of the places."""
        limits = [part.flatten()[index] for part in (self.lowest, self.highest) if part is not None]
        return EffectorOverTote(self.leaves_tote.flatten()[index], self.rim, self.obstacle.flatten()[index], *limits)


#: The failure, the scope, and a function of the scope's facts that returns whether the check is passed, or the height;
#: None: there is nothing to check.
CHECKS: tuple[tuple[Failure, int, Callable[[Any], Tensor | None]], ...] = (
    (Failure.PICK_MISS, PICK, lambda pick: pick.grips),
    (Failure.BIN_COLLISION, PICK, lambda pick: ~pick.collides),
    (Failure.TOTE_COLLISION, FOOTPRINT, lambda resting: resting.inside),
    (Failure.TOTE_COLLISION, LEAST_TOP, lambda effector: torch.where(effector.leaves_tote, effector.rim, NEVER)),
    (Failure.OVERFLOW, FOOTPRINT, lambda resting: resting.top <= resting.rim),
    (Failure.ITEM_COLLISION, LEAST_TOP, lambda effector: effector.obstacle),
    (Failure.UNSTABLE, FOOTPRINT, lambda resting: resting.stable),
    (Failure.OUT_OF_REACH, PICK, lambda pick: pick.reachable),
    (Failure.OUT_OF_REACH, LEAST_TOP, lambda effector: effector.lowest),
    (Failure.OUT_OF_REACH, GREATEST_TOP, lambda effector: effector.highest),
    (Failure.FORBIDDEN_TURN, TURN, lambda allowed: allowed),
    (Failure.OVERLOADED, FOOTPRINT, lambda resting: resting.borne),
)

#: The failures that the pick alone decides, wherever the item is placed: their checks come first.
PICK_FAILURES = tuple(kind for kind, scope, _ in takewhile(lambda check: check[1] == PICK, CHECKS))

_FINDS = {scope: [find for _, where, find in CHECKS if where == scope] for scope in _COMBINE}


def combine(scope: int, facts: Any) -> Any:
    """Return whether all checks of a scope are passed, bool, or the height that passes all; None: no checks."""
    values = [value for find in _FINDS[scope] if (value := find(facts)) is not None]
    return reduce(_COMBINE[scope], values) if values else None


def first_failure(pick: Any, resting: Resting, effector: EffectorOverTote, turn: Tensor | None = None) -> Tensor:
    """Return the failure code of the first check that each action does not pass, int64; 0 if it passes all.

    ``turn`` is whether the action's rotation is allowed; None: all are.
    """
    failure = torch.zeros_like(resting.top)
    facts = {PICK: pick, FOOTPRINT: resting, LEAST_TOP: effector, GREATEST_TOP: effector, TURN: turn}
    for kind, scope, find in reversed(CHECKS):  # so that the first failed check is written last
        if (value := find(facts[scope])) is not None:
            passed = _COMPARE[scope](resting.top, value) if scope in _COMPARE else value
            failure = torch.where(passed, failure, int(kind))
    return failure


def is_within_reach(lowest: Tensor, highest: Tensor, face: Tensor) -> Tensor:
    """Return whether the height of the suction face is within the robot's limits, see ``CellSpec.limits``."""
    return (lowest <= face) & (face <= highest)
