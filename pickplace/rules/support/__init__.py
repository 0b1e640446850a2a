"""Stability rules: whether what an item rests on keeps it stable, and where it may bear weight itself."""

from typing import Any

from pickplace.common.validate import is_number, one_of
from pickplace.rules.support.base import Support
from pickplace.rules.support.rules import Bearing, Corners, Full, Half, HalfOrHull, Hull, MoreThanHalf, Share

#: The rules that a short form names; a number is the least share.
RULES: dict[str, type[Support]] = {
    "half": Half,
    "more_than_half": MoreThanHalf,
    "hull": Hull,
    "bearing": Bearing,
    "half_or_hull": HalfOrHull,
    "corners": Corners,
    "full": Full,
}


def read_support(value: Any) -> Support:
    """Return a stability rule as it is, or the one of a short form: of a name or, for :class:`Share`, a number.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(value, Support):
        return value
    if is_number(value) and 0 <= value <= 1:
        return Share(value)
    return RULES[one_of("support", value, RULES, "a number between 0 and 1, or an object of a rule's class")]()
