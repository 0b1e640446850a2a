"""Checks of settings: each returns the value, or raises a ``ValueError`` that names the key and what was expected."""

import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from reprlib import Repr
from typing import Any

#: Greatest count that the program's tensors and files hold.
MAX_COUNT = 2**63 - 1

#: The environment variable that limits the memory of one batch, and the limit on a CPU without it, in gigabytes.
MEMORY_VARIABLE, CPU_GIGABYTES = "PICKPLACE_MEMORY_GB", 0.8

#: Greatest width of a layer, and greatest number of inputs of a neuron.
MAX_WIDTH, MAX_INPUTS = 1_024, 8_192


class _Repr(Repr):
    """Representations of values without addresses of objects."""

    def repr_instance(self, x, level):
        has_address = type(x).__repr__ is object.__repr__  # type: ignore[comparison-overlap]
        return type(x).__name__ if has_address else super().repr_instance(x, level)


_repr = _Repr()
_repr.maxstring = _repr.maxother = 80


def excerpt(value) -> str:
    """Return the representation of a value for a message, on one line, cut to some 100 characters."""
    text = " ".join(map(str.strip, _repr.repr(value).splitlines()))
    return text if len(text) <= 120 else f"{text[:80]}...{text[-30:]}"


def short_text(name) -> str:
    """Return a name for a message, like :func:`excerpt` but without quotes."""
    return excerpt(str(name))[1:-1]


def first_line(error: Exception) -> str:
    """Return the first line of an error's text, or its type if it has none."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def expect(good: Any, key: str, value: Any, expected: str) -> Any:
    """Return ``value`` if ``good``, else raise a ``ValueError`` that says what was expected."""
    if not good:
        raise ValueError(f"{key}={excerpt(value)}: expected {expected}.")
    return value


def refuse_if(bad: Any, message: str, error: type[Exception] = ValueError) -> None:
    """Raise an error with a message if ``bad``."""
    if bad:
        raise error(message)


def refuse_any(found: Iterable, message: Callable[[Any], str], error: type[Exception] = ValueError) -> None:
    """Raise an error about the first element of ``found``, if there is any."""
    for first in found:
        raise error(message(first))


def unique_keys(pairs: list[tuple[str, Any]]) -> dict:
    """Return a JSON object as a dict. Refuse a key that occurs twice: parsers disagree on which value to keep."""
    found: dict = {}
    for key, value in pairs:
        refuse_if(key in found, f"{excerpt(key)} stands twice in an object; expected each key once.")
        found[key] = value
    return found


@contextmanager
def reword_errors(errors, new: Callable[[Any], Exception]) -> Iterator[None]:
    """Raise ``new(error)`` instead of an error of these types in the block."""
    try:
        yield
    except errors as error:
        raise new(error) from error


def refuse_above(words: str, count: int, what: str, most: int) -> None:
    """Refuse a count that is too great; the message begins with ``words``."""
    refuse_if(count > most, f"{words} {count:,} {what}; expected at most {most:,}.")


def is_whole(value) -> bool:
    """Return whether a value is an integer of Python's or numpy's, and not a bool."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite real number, and not a bool."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number that no float can hold
        return False


def whole_number(key: str, value, least: int = 1, most: int = MAX_COUNT) -> int:
    """Return ``value`` if it is a whole number in ``[least, most]``."""
    limit = "< 2**63" if most == MAX_COUNT else f"<= {most:,}"
    return int(expect(is_whole(value) and least <= value <= most, key, value, f"a whole number >= {least} and {limit}"))


def whole_numbers(place: str, most: int, **values) -> None:
    """Check settings at one place of the config, by their keys: each is a whole number in ``[1, most]``."""
    for key, value in values.items():
        whole_number(f"{place}.{key}", value, most=most)


def integral_number(key: str, value, least: int = 1, most: int = MAX_COUNT) -> int:
    """Return ``value`` as an int, like :func:`whole_number`; a float such as 5e6 is accepted."""
    return whole_number(key, int(value) if isinstance(value, float) and value.is_integer() else value, least, most)


def number(key: str, value, least: float = 0.0, most: float | None = None, what: str = "a number") -> float:
    """Return ``value`` if it is a finite number in ``[least, most]``; ``most=None`` means no upper limit.

    Args:
        what: for the message: a number, or its unit.
    """
    limits = f">= {least:g}" if most is None else f"between {least:g} and {most:g}"
    good = is_number(value) and least <= value and (most is None or value <= most)
    return expect(good, key, value, f"{what} {limits}")


def is_name(value: Any) -> bool:
    """Return whether a value is a short text that a terminal can show."""
    return isinstance(value, str) and value.isprintable() and len(value) <= 100


def flag(key: str, value) -> bool:
    """Return ``value`` if it is true or false."""
    return expect(isinstance(value, bool), key, value, "true or false")


def one_of(key: str, value, choices, alternative: str | None = None) -> str:
    """Return ``value`` if it is a text among the choices; the message names an alternative, if there is one."""
    expected = [*map(repr, choices), *([alternative] if alternative else [])]
    return expect(isinstance(value, str) and value in choices, key, value, " or ".join(expected))


def size_tuple(name: str, value, count: int, most: int) -> tuple[int, ...]:
    """Return ``value`` as a tuple of ``count`` positive ints that are at most ``most``."""
    try:
        sizes = tuple(int(v) for v in value)
        exact = all(int(v) == v and not isinstance(v, bool) for v in value)
    except (TypeError, ValueError, OverflowError):
        sizes, exact = (), False
    good = exact and len(sizes) == count and min(sizes) >= 1 and max(sizes) <= most
    expect(good, name, value, f"{count} whole numbers >= 1 and <= {most:,}")
    return sizes


def odd_number(key: str, value, least: int = 1, most: int = 99) -> int:
    """Return ``value`` if it is an odd whole number in ``[least, most]``."""
    good = is_whole(value) and least <= value <= most and value % 2
    return int(expect(good, key, value, f"an odd number >= {least} and <= {most}"))


def or_null(check: Callable[..., Any], key: str, value, *limits) -> Any:
    """Return None for None, and the result of a validator for any other value; its error also names null."""
    if value is None:
        return None
    with reword_errors(ValueError, lambda error: ValueError(f"{str(error).rstrip('.')}, or null.")):
        return check(key, value, *limits)


def check_inputs(key: str, count: int) -> None:
    """Refuse a layer with more inputs than :data:`MAX_INPUTS`."""
    refuse_above(f"{key}: a neuron would have", count, "inputs", MAX_INPUTS)


def check_bytes(setting: str, needed: int, device="cpu") -> None:
    """Refuse settings whose tensors would fill the memory: :data:`CPU_GIGABYTES`, or half of a GPU's.

    The environment variable ``PICKPLACE_MEMORY_GB`` sets another limit. A checkpoint cannot.

    Args:
        setting: the keys and their values, for the message.
        needed: bytes that they would take.
        device: device of the tensors.
    """
    import torch  # only when needed: the other checks work without it

    device, given = torch.device(device), os.environ.get(MEMORY_VARIABLE)
    most = torch.cuda.get_device_properties(device).total_memory / 2e9 if device.type == "cuda" else CPU_GIGABYTES
    with reword_errors(
        ValueError, lambda _: ValueError(f"{MEMORY_VARIABLE}={excerpt(given)}: expected a number of gigabytes.")
    ):
        most = most if given is None else number(MEMORY_VARIABLE, float(given))
    refuse_if(
        needed > most * 1e9,
        f"{setting}: it would take {needed / 1e9:,.2f} GB; expected at most {most:.4g} GB, or a greater limit in "
        f"the environment variable {MEMORY_VARIABLE}.",
    )
