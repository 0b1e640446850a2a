"""References between keys of a config, ``${..actor.filters}``: which ones a checkpoint keeps, and may hold."""

import re
from collections.abc import Collection, Iterator
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


def select_groups(content: dict, groups: Collection[str]) -> dict:
    """Return some groups of a config, in which references to values in other groups are replaced by the values."""

    def replaced(node, path: tuple):
        if isinstance(node, dict):
            return {key: replaced(value, (*path, key)) for key, value in node.items()}
        if isinstance(node, list):
            return [replaced(value, (*path, index)) for index, value in enumerate(node)]
        if path[-1] != "_target_" and _is_reference_to_value(node, path, content):
            target = _target_path(node, path)
            return node if target[0] in groups else reduce(getitem, target, content)
        return node

    return {key: replaced(content[key], (key,)) for key in groups if key in content}


def _target_path(text: str, path: tuple) -> tuple:
    """Return the path of the value to which a reference at a path leads."""
    reference = text[2:-1]  # without the braces
    keys = reference.lstrip(".")
    dots = len(reference) - len(keys)
    return (*(path[:-dots] if dots else ()), *keys.split("."))


def _is_reference_to_value(text, path: tuple, root) -> bool:
    """Return whether a text is a reference to a number, a short text, or a short list of such."""
    if not isinstance(text, str) or not REFERENCE.fullmatch(text):
        return False
    try:
        found = reduce(getitem, _target_path(text, path), root)
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
    return ValueError(f"{short_text(key)}={excerpt(value)}: the checkpoint is refused; expected {expected}.")
