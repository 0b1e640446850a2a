"""References between keys of a config, ``${..actor.filters}``: which ones a checkpoint keeps, and may hold."""

import re
import reprlib
from collections.abc import Iterator
from functools import reduce
from operator import getitem
from typing import Any

from omegaconf import DictConfig, OmegaConf

#: A reference to another key of the same config, and nothing else.
REFERENCE = re.compile(r"\$\{(\.*)([A-Za-z_]\w*(?:\.\w+)*)\}")


def saved_form(cfg: DictConfig) -> dict:
    """Return the config of a run as its checkpoints hold it, without ``trust``, which every reader states anew.

    References to values stay, so that an override reaches both keys. Other interpolations are resolved.
    """
    raw: Any = OmegaConf.to_container(cfg, resolve=False)
    saved: Any = OmegaConf.to_container(cfg, resolve=True)

    def restore_references(node, path: tuple = ()) -> None:
        for key, value in children(node):
            restore_references(value, (*path, key))
            if key != "_target_" and _is_reference_to_value(value, (*path, key), raw):
                reduce(getitem, path, saved)[key] = value

    restore_references(raw)
    return {**saved, "trust": []}


def refuse_interpolations(node, path: tuple = (), root=None) -> None:
    """Refuse all interpolations but references to values in the same config, before anything resolves them.

    A resolver reads files and variables, or makes nodes. A reference to a part, or to another reference, could copy
    parts into parts until the memory is full.

    Raises:
        ValueError: naming the interpolation and its place.
    """
    root = node if root is None else root
    if isinstance(node, str) and "${" in node and not _is_reference_to_value(node, path, root):
        expected = "no interpolation but a reference to a number, a short text or a short list of such"
        raise refusal(".".join(map(str, path)), node, expected)
    for key, value in children(node):
        refuse_interpolations(value, (*path, key), root)


def _is_reference_to_value(text, path: tuple, root) -> bool:
    """Return whether a text is a reference to a number, a short text, or a short list of such."""
    if not isinstance(text, str) or not (reference := REFERENCE.fullmatch(text)):
        return False
    dots, keys = reference.groups()
    try:
        found = reduce(getitem, (*(path[: -len(dots)] if dots else ()), *keys.split(".")), root)
    except (KeyError, TypeError):  # a TypeError from a key of a list or of a value
        return False
    values = found if isinstance(found, list) else [found]
    plain = [not isinstance(value, (dict, list)) and "${" not in str(value) for value in values]
    return all(plain) and len(values) <= 100 and all(len(str(value)) <= 1000 for value in values)


def children(node) -> Iterator[tuple]:
    """Yield the keys and values of a dict, or the indices and values of a list; nothing for anything else."""
    yield from node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()


def refusal(key: str, value, expected: str) -> ValueError:
    """Return the error for a value of a checkpoint's config."""
    return ValueError(f"{key}={reprlib.repr(value)}: the checkpoint is refused; expected {expected}.")
