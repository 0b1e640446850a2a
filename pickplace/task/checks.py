"""Checks of settings: each returns the value, or raises a ``ValueError`` that names the key and what was expected."""

import math
import reprlib
from numbers import Integral, Real


def is_whole(value) -> bool:
    """Return whether a value is an integer of Python's or numpy's, and not a bool."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value) -> bool:
    """Return whether a value is a finite real number, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def whole_number(key: str, value, least: int = 1, most: int | None = None) -> int:
    """Return ``value`` if it is a whole number in ``[least, most]``; ``most=None`` means no upper limit."""
    if not is_whole(value) or value < least or (most is not None and value > most):
        limit = "" if most is None else f" and <= {most:,}"
        raise ValueError(f"{key}={reprlib.repr(value)}: expected a whole number >= {least}{limit}.")
    return int(value)


def number(key: str, value, least: float = 0.0, most: float | None = None) -> float:
    """Return ``value`` if it is a finite number in ``[least, most]``; ``most=None`` means no upper limit."""
    if not is_number(value) or value < least or (most is not None and value > most):
        limit = "" if most is None else f" and <= {most:g}"
        raise ValueError(f"{key}={reprlib.repr(value)}: expected a number >= {least:g}{limit}.")
    return value


def flag(key: str, value) -> bool:
    """Return ``value`` if it is true or false."""
    if not isinstance(value, bool):
        raise ValueError(f"{key}={reprlib.repr(value)}: expected true or false.")
    return value


def one_of(key: str, value, choices) -> str:
    """Return ``value`` if it is among the choices."""
    if value not in choices:
        raise ValueError(f"{key}={reprlib.repr(value)}: expected {' or '.join(map(repr, choices))}.")
    return value


def odd_number(key: str, value, least: int = 1) -> int:
    """Return ``value`` if it is an odd whole number of at least ``least``."""
    if not is_whole(value) or value < least or value % 2 == 0:
        raise ValueError(f"{key}={reprlib.repr(value)}: expected an odd number >= {least}.")
    return int(value)
