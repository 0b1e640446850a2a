"""Checks of a curriculum's settings; each error names the key, the value and what was expected."""

from pickplace.task import checks


def whole_number(key: str, value, least: int = 1, greatest: int = checks.MAX_COUNT) -> int:
    """Return ``value`` as an int in ``[least, greatest]``; a float such as 5e6 is accepted.

    Raises:
        ValueError: for any other value.
    """
    is_integral = isinstance(value, float) and value.is_integer()
    return checks.whole_number(key, int(value) if is_integral else value, least, greatest)


def fraction(key: str, value) -> float:
    """Return ``value`` as a float in ``[0, 1]``.

    Raises:
        ValueError: for any other value.
    """
    return float(checks.number(key, value, 0, 1))


def is_finite_number(value) -> bool:
    """Return whether ``value`` is a finite Python number, which JSON stores exactly."""
    return isinstance(value, (int, float)) and checks.is_number(value)
