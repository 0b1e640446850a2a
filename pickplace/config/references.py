"""References between keys of a config, ``${..actor.filters}``: which ones a checkpoint keeps, and may hold."""

import re
from collections.abc import Collection, Iterator
from copy import deepcopy
from functools import reduce
from operator import getitem
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pickplace.common.validate import excerpt, short_text

#: A reference to another key of the same config, and nothing else.
REFERENCE = re.compile(r"\$\{(\.*)([A-Za-z_]\w*(?:\.\w+)*)\}")


def saved_form(cfg: DictConfig) -> dict:
    """Return the config of a run as its checkpoints hold it, without ``trust``, which every reader states anew.

    References to values stay, so that an override reaches both keys. Other interpolations are resolved.
    """
    raw: Any = OmegaConf.to_container(cfg, resolve=False)
    saved: Any = OmegaConf.to_container(cfg, resolve=True)
    for path, value in walk(raw):
        if _is_reference(value, path, raw):
            _put(saved, path, value)
    return {**saved, "trust": []}


def refuse_interpolations(root: dict) -> None:
    """Refuse all interpolations but references to values in the same config, before anything resolves them.

    A resolver reads files and variables, or makes nodes. A reference to a part, or to another reference, could copy
    parts into parts until the memory is full.

    Raises:
        ValueError: naming the interpolation and its place.
    """
    for path, value in walk(root):
        if isinstance(value, str) and "${" in value and not _is_reference(value, path, root):
            expected = "no interpolation but a reference to a number, a short text or a short list of such"
            raise refusal(".".join(map(str, path)), value, expected)


def select_groups(content: dict, groups: Collection[str]) -> dict:
    """Return some groups of a config, in which references to values in other groups are replaced by the values."""
    selected = deepcopy({key: content[key] for key in groups if key in content})
    for path, value in list(walk(selected)):
        if _is_reference(value, path, content) and (target := _target_path(value, path))[0] not in groups:
            _put(selected, path, reduce(getitem, target, content))
    return selected


def _target_path(text: str, path: tuple) -> tuple:
    """Return the path of the value to which a reference at a path leads."""
    reference = text[2:-1]  # without the braces
    keys = reference.lstrip(".")
    dots = len(reference) - len(keys)
    return (*(path[:-dots] if dots else ()), *keys.split("."))


def _is_reference(text, path: tuple, root) -> bool:
    """Return whether a text at a path is a reference to a number, a short text, or a short list of such."""
    if not isinstance(text, str) or not REFERENCE.fullmatch(text) or path[-1] == "_target_":
        return False
    try:
        found = reduce(getitem, _target_path(text, path), root)
    except (KeyError, TypeError):  # a TypeError from a key of a list or of a value
        return False
    values = found if isinstance(found, list) else [found]
    plain = [not isinstance(value, (dict, list)) and "${" not in str(value) for value in values]
    return all(plain) and len(values) <= 100 and all(len(str(value)) <= 1000 for value in values)


def _put(root, path: tuple, value) -> None:
    reduce(getitem, path[:-1], root)[path[-1]] = value


def walk(node, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Yield the path and the value of a node and of all nodes within it."""
    yield path, node
    for key, value in children(node):
        yield from walk(value, (*path, key))


def children(node) -> Iterator[tuple]:
    """Yield the keys and values of a dict, or the indices and values of a list; nothing for anything else."""
    yield from node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()


def refusal(key: str, value, expected: str) -> ValueError:
    """Return the error for a value of a checkpoint's config."""
    return ValueError(f"{short_text(key)}={excerpt(value)}: the checkpoint is refused; expected {expected}.")
