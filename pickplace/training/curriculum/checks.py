"""Checks of a curriculum's settings; each error names the key, the value and what was expected."""

import math


def whole_number(key: str, value, least: int = 1, greatest: float = math.inf) -> int:
    """Return ``value`` as an int in ``[least, greatest]``; a float such as 5e6 is accepted.

    Raises:
        ValueError: for any other value.
    """
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or value % 1 != 0 or not least <= value <= greatest:
        limit = f" and <= {greatest}" if greatest < math.inf else ""
        raise ValueError(f"{key}={value!r}: expected a whole number >= {least}{limit}.")
    return int(value)


def fraction(key: str, value) -> float:
    """Return ``value`` as a float in ``[0, 1]``.

    Raises:
        ValueError: for any other value.
    """
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value <= 1:
        raise ValueError(f"{key}={value!r}: expected a number between 0 and 1.")
    return float(value)


def is_finite_number(value) -> bool:
    """Return whether ``value`` is a finite Python number, which JSON stores exactly."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < math.inf
