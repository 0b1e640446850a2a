"""Write and read checkpoints.

A checkpoint is a folder with ``state.safetensors`` (all tensors, random generators included) and ``state.json``
(config, counters, and the checksum of the tensors). It is data: reading one unpickles nothing and imports nothing.
It is written beside its place and then renamed. So a reader finds either the old or the new one, and always a whole
one, also after a power failure.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from pickplace.common.files import read_file, sync_folder
from pickplace.common.validate import excerpt, expect, first_line, is_whole, refuse_any, refuse_if, reword_errors
from pickplace.runs.locate import FACTS, MAX_BYTES, PREVIOUS, TENSORS, CheckpointError, are_facts

SCHEMA = 1

Module = TypeVar("Module", bound=torch.nn.Module)


def write(folder: Path, state: dict, facts: dict, keep: str | None = None) -> None:
    """Write a checkpoint folder, replacing an older one as a whole.

    Args:
        folder: the checkpoint folder.
        state: nested dicts of tensors and plain values.
        facts: further content of the readable JSON file: config, counters, metrics.
        keep: name under which the older one is kept beside it; None: it is removed.

    Raises:
        CheckpointError: if it cannot be written. The older one stays whole, and nothing half-written remains.
    """
    new, old = folder.with_name(f".{folder.name}.new"), folder.with_name(f".{folder.name}.old")
    tensors, rest = flatten(state)
    blob = save(tensors)
    facts = {"schema": SCHEMA, "sha256": hashlib.sha256(blob).hexdigest(), **facts, "state": rest}
    contents = {TENSORS: blob, FACTS: json.dumps(facts, indent=1).encode()}
    for name, content in contents.items():
        refuse_if(
            len(content) > (most := MAX_BYTES[name]),
            f"{folder}: {name} has more than {most:,} bytes; nobody could read it.",
            CheckpointError,
        )
    shutil.rmtree(new, ignore_errors=True)
    try:
        new.mkdir(parents=True)
        for name, content in contents.items():
            with open(new / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        sync_folder(new)  # its names must be on the disk before it replaces the older one
        if old.exists() and not folder.exists():  # the process was killed between the renames below
            old.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            folder.rename(old)  # locate() finds it there if the process is killed now
        new.rename(folder)
        if keep is not None and old.exists():
            shutil.rmtree(folder.with_name(keep), ignore_errors=True)
            old.rename(folder.with_name(keep))
        sync_folder(folder.parent)
    except OSError as error:
        shutil.rmtree(new, ignore_errors=True)
        raise CheckpointError(f"{folder}: the checkpoint cannot be written ({error}).") from error
    shutil.rmtree(old, ignore_errors=True)


def check_state(state, name: str) -> None:
    """Refuse a state that would not come back from a checkpoint as it is.

    Args:
        state: nested dicts of tensors, numbers, texts and None.
        name: of the state, for messages.

    Raises:
        ValueError: naming the first value or key of another kind.
    """
    expect(isinstance(state, dict), name, state, "nested dicts of tensors, numbers and texts")
    for key, value in state.items():
        is_text = isinstance(key, str) and not key.isdecimal() and "|" not in key
        expected = "a whole number, or a text that is no number and has no |"
        expect(is_text or (is_whole(key) and key >= 0), f"{name}: the key", key, expected)
        if not isinstance(value, Tensor | int | float | str | None):
            check_state(value, f"{name}|{key}")


def check_loads(owner, name: str) -> None:
    """Refuse an object whose class saves a state of its own, and loads only what its base class knows.

    Raises:
        ValueError: a resume would lose the state without a word.
    """
    classes = type(owner).__mro__
    saves, loads = (next(each for each in classes if key in vars(each)) for key in ("state_dict", "load_state_dict"))
    forgets = classes.index(saves) < classes.index(loads)
    refuse_if(forgets, f"{name}: {saves.__name__} has a state_dict without a load_state_dict; expected both.")


def flatten(tree, prefix: str = "") -> tuple[dict[str, Tensor], dict]:
    """Split nested dicts and lists into tensors by path, and plain values by path."""
    tensors: dict[str, Tensor] = {}
    facts: dict = {}
    for key, value in enumerate(tree) if isinstance(tree, (list, tuple)) else tree.items():
        path = f"{prefix}{key}"
        if isinstance(value, Tensor):
            tensors[path] = value.detach().cpu().contiguous().clone()  # safetensors refuses tensors that share memory
        elif isinstance(value, (dict, list, tuple)) and value:
            for found, more in zip((tensors, facts), flatten(value, path + "|"), strict=True):
                found.update(more)
        else:
            facts[path] = value
    return tensors, facts


def unflatten(tensors: dict[str, Tensor], facts: dict) -> dict:
    """Return the tree that :func:`flatten` split; lists come back as dicts with whole-number keys.

    Raises:
        ValueError: for a path that goes on below another value, or occurs twice.
    """
    tree: dict = {}
    for path, value in [*tensors.items(), *facts.items()]:
        node = tree
        *parents, leaf = (int(part) if part.isdecimal() else part for part in path.split("|"))
        for parent in parents:
            node = node.setdefault(parent, {}) if isinstance(node, dict) else None
        refuse_if(not isinstance(node, dict) or leaf in node, f"{path!r} is below another value, or twice there")
        node[leaf] = value
    return tree


def read(folder: Path) -> tuple[dict, dict]:
    """Return the state and the facts of a checkpoint folder.

    Raises:
        CheckpointError: if a file is missing, truncated or altered, or of another schema; the message names the
            newest whole checkpoint beside it, if there is one.
    """
    before = _identity(folder)
    try:
        return _read(folder)
    except CheckpointError as error:
        time.sleep(0.01)  # between the renames the folder is missing
        if _identity(folder) != before:  # a training replaced it between the reading of its two files
            return read(folder)
        whole = []
        for name in (PREVIOUS, "last", "best") if folder.parent.name == "checkpoints" else ():
            with suppress(CheckpointError):
                whole.append((_read(folder.with_name(name))[1]["frames"], folder.with_name(name)))
        if not whole:
            raise
        frames, other = max(whole)
        raise CheckpointError(f"{error} {other}, at {frames:,} frames, is whole.") from error


def _identity(folder: Path) -> list[tuple[int, int]] | None:
    """Return inodes and times of a checkpoint's files, which no other checkpoint has; None if a file is missing."""
    try:
        found = [(folder / name).lstat() for name in (FACTS, TENSORS)]
    except OSError:
        return None
    return [(entry.st_ino, entry.st_mtime_ns) for entry in found]


def _read(folder: Path) -> tuple[dict, dict]:
    """Read a checkpoint's two files, and check schema and checksum."""
    with reword_errors(
        (OSError, ValueError, RecursionError),  # a RecursionError from deeply nested JSON
        lambda error: CheckpointError(f"{folder}: the checkpoint cannot be read ({error})."),
    ):
        content, blob = (read_file(folder / name, MAX_BYTES[name], links=False) for name in (FACTS, TENSORS))
        facts = json.loads(content)
    found = facts.get("schema") if isinstance(facts, dict) else None
    refuse_if(
        found != SCHEMA,
        f"{folder}: schema {excerpt(found)}, expected {SCHEMA}; another version wrote it.",
        CheckpointError,
    )
    refuse_if(
        hashlib.sha256(blob).hexdigest() != facts.get("sha256"),
        f"{folder}: {TENSORS} is truncated or altered, its checksum does not match {FACTS}.",
        CheckpointError,
    )
    with reword_errors(
        (SafetensorError, KeyError, TypeError, ValueError, RuntimeError),  # unknown types, absurd sizes
        lambda error: CheckpointError(f"{folder}: {TENSORS} cannot be read ({first_line(error)})."),
    ):
        tensors = load(blob)
    state = facts.pop("state", None)
    refuse_if(
        not isinstance(state, dict) or not are_facts(facts),
        f"{folder}: {FACTS} lacks its state, config or frames; expected what a training wrote.",
        CheckpointError,
    )
    with reword_errors(
        ValueError,
        lambda error: CheckpointError(f"{folder}: {FACTS} and {TENSORS} do not fit each other ({error})."),
    ):
        state = unflatten(tensors, state)
    refuse_if(
        not isinstance(state.get("policy"), dict),
        f"{folder}: {TENSORS} has no policy; expected what a training wrote.",
        CheckpointError,
    )
    return state, facts


def restore(make: Callable[[], Module], state: dict, what: str) -> Module:
    """Return the module of ``make()`` with a checkpoint's tensors.

    Sizes are compared before memory is allocated, so a config that asks for too much memory is refused.

    Raises:
        CheckpointError: see :func:`matching_state`; also for a tensor that the module does not have.
    """
    with torch.device("meta"):
        own = make().state_dict()
    weights = matching_state(state, own, what)
    refuse_any(
        sorted(map(str, set(state) - set(own))),
        lambda key: f"The checkpoint's {what} does not fit these settings: {key} is not expected.",
        CheckpointError,
    )
    module = make()
    module.load_state_dict(weights)
    return module


def matching_state(saved, own: dict, what: str, path: str = "") -> dict:
    """Return the part of a checkpoint's state that the training needs; check its names, types and shapes.

    Args:
        saved: the checkpoint's state.
        own: the training's state: nested dicts of tensors and plain values.
        what: name of the state, for messages.
        path: place in the state, for messages.

    Raises:
        CheckpointError: naming the first value that is missing, of another type or shape, or not finite.
    """
    found = {}
    for key, expected in own.items():
        value, name = saved.get(key) if isinstance(saved, dict) else None, f"{path}{key}"
        if key == "cuda_rng" and value is None:  # saved without a GPU
            continue
        if isinstance(expected, dict):
            value = matching_state(value, expected, what, f"{name}|")
        else:
            refuse_if(
                (kind := _kind(value)) != (wanted := _kind(expected)),
                f"The checkpoint's {what} does not fit these settings: {name} is {kind}, expected "
                f"{'None' if expected is None else wanted}.",
                CheckpointError,
            )
            refuse_if(
                isinstance(value, Tensor) and not value.isfinite().all(),
                f"The checkpoint's {what} is of no use: {name} holds values that are not finite.",
                CheckpointError,
            )
        found[key] = value
    return found


def _kind(value) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} of shape {tuple(value.shape)}"
    return "missing" if value is None else type(value).__name__
