"""Checkpoints: what is saved, how it is written, how it is trusted.

A checkpoint is a folder with ``state.safetensors`` (every tensor, random generators included) and ``state.json``
(config, counters, and the checksum of the tensors). It is data, not code: nothing in it is unpickled or imported.
It is written beside its place and renamed into it: a reader finds the old one or the new one, never half of one.
"""

import hashlib
import json
import os
import shutil
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

SCHEMA = 1
PRETRAINED = Path(__file__).resolve().parent.parent / "pretrained"  # weights that the package ships
TENSORS, FACTS = "state.safetensors", "state.json"
PREVIOUS = "previous"  # beside checkpoints/last, the one before it

Module = TypeVar("Module", bound=torch.nn.Module)


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, or does not fit; the message is one sentence."""


def flatten(tree, prefix: str = "") -> tuple[dict[str, Tensor], dict]:
    """Split nested dicts and lists into tensors by path, and the rest as JSON with paths for leaves."""
    tensors, facts = {}, {}
    items = enumerate(tree) if isinstance(tree, (list, tuple)) else tree.items()
    for key, value in items:
        path = f"{prefix}{key}"
        if isinstance(value, Tensor):
            # A clone: safetensors refuses tensors that share memory.
            tensors[path] = value.detach().cpu().contiguous().clone()
        elif isinstance(value, (dict, list, tuple)):
            more_tensors, more_facts = flatten(value, path + "|")
            tensors.update(more_tensors)
            facts.update(more_facts)
            if not value:
                facts[path] = [] if isinstance(value, (list, tuple)) else {}
        else:
            facts[path] = value
    return tensors, facts


def unflatten(tensors: dict[str, Tensor], facts: dict) -> dict:
    """The inverse of :func:`flatten`; lists come back as dicts with whole-number keys.

    Raises:
        ValueError: for a path that goes on below another one's leaf.
    """
    tree: dict = {}
    for path, value in [*tensors.items(), *facts.items()]:
        node = tree
        *parents, leaf = (int(part) if part.isdecimal() else part for part in path.split("|"))
        for parent in parents:
            node = node.setdefault(parent, {}) if isinstance(node, dict) else None
        if not isinstance(node, dict) or leaf in node:
            raise ValueError(f"{path!r} stands where something else stands")
        node[leaf] = value
    return tree


def write(folder: Path, state: dict, facts: dict, keep: str | None = None) -> None:
    """Write a checkpoint folder, replacing an older one as a whole.

    Args:
        folder: where the checkpoint shall be.
        state: nested dicts of tensors and plain values.
        facts: what to keep beside it as readable JSON: config, counters, metrics.
        keep: the name under which the older one stays beside it; None: it is taken away.

    Raises:
        CheckpointError: if it cannot be written; the older one is whole, and nothing half-written stays.
    """
    folder = Path(folder)
    fresh, old = folder.with_name(f".{folder.name}.new"), folder.with_name(f".{folder.name}.old")
    tensors, rest = flatten(state)
    blob = save(tensors)
    digest = hashlib.sha256(blob).hexdigest()
    text = json.dumps({"schema": SCHEMA, "sha256": digest, **facts, "state": rest}, indent=1)
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        fresh.mkdir(parents=True)
        for name, content in ((TENSORS, blob), (FACTS, text.encode())):
            with open(fresh / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        if old.exists() and not folder.exists():  # a kill between the renames below left it so
            old.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            folder.rename(old)  # if we are killed right here, locate() finds the old one
        fresh.rename(folder)
        if keep is not None and old.exists():
            kept = folder.with_name(keep)
            shutil.rmtree(kept, ignore_errors=True)
            old.rename(kept)
    except OSError as error:
        shutil.rmtree(fresh, ignore_errors=True)
        raise CheckpointError(f"{folder}: the checkpoint cannot be written ({error}).") from error
    shutil.rmtree(old, ignore_errors=True)


def locate(path, prefer: str = "best") -> Path:
    """The checkpoint folder that a user means.

    Args:
        path: a run folder (then its ``checkpoints/<prefer>``), a checkpoint, or ``pretrained/<name>``: weights that
            the package ships, unless a folder of that name is here.
        prefer: ``"best"``, or ``"last"`` to go on with a run; then one that was killed before its first ``last`` goes
            on from ``best``.

    Raises:
        CheckpointError: if there is none.
    """
    parts = Path(path).parts
    if len(parts) == 2 and parts[0] == "pretrained" and not Path(path).exists():
        if not (PRETRAINED / parts[1] / FACTS).is_file():
            names = ", ".join(f"pretrained/{folder.parent.name}" for folder in sorted(PRETRAINED.glob(f"*/{FACTS}")))
            raise CheckpointError(f"checkpoint={str(path)!r}: the package ships no such weights; expected {names}.")
        return PRETRAINED / parts[1]
    path = Path(path).absolute()
    preferred = ("last", "best") if prefer == "last" else (prefer,)
    for folder in (*(path / "checkpoints" / name for name in preferred), path):
        for candidate in (folder, folder.with_name(f".{folder.name}.old")):
            if (candidate / FACTS).is_file():
                return candidate
    key = "resume" if prefer == "last" else "checkpoint"
    for other in (path / "checkpoints" / name for name in ("last", PREVIOUS)):
        if (other / FACTS).is_file():
            raise CheckpointError(f"{key}={str(path)!r}: no {prefer} checkpoint there; expected {key}={other}.")
    raise CheckpointError(
        f"{key}={str(path)!r}: no checkpoint there; expected a run folder, or one of its checkpoints: best, last or "
        "previous."
    )


def read_facts(path, prefer: str = "best") -> dict:
    """The facts of the checkpoint that :func:`locate` finds, without its tensors, so unchecked; empty if unreadable."""
    try:
        facts = json.loads((locate(path, prefer) / FACTS).read_bytes())
    except (CheckpointError, OSError, ValueError, RecursionError):
        return {}
    whole = isinstance(facts, dict) and isinstance(facts.get("frames"), int) and isinstance(facts.get("config"), dict)
    return facts if whole else {}


def read(folder: Path) -> tuple[dict, dict]:
    """Read a checkpoint folder: the state as written, and its facts.

    Raises:
        CheckpointError: if a file is missing, truncated or altered, or of another schema; the sentence offers the
            newest whole checkpoint beside it, if there is one.
    """
    try:
        return _read_whole(folder)
    except CheckpointError as error:
        others = []
        for name in [PREVIOUS, "last", "best"] if Path(folder).parent.name == "checkpoints" else []:
            try:
                others.append((_read(Path(folder).with_name(name))[1]["frames"], Path(folder).with_name(name)))
            except CheckpointError:
                continue
        if not others:
            raise
        frames, other = max(others)
        raise CheckpointError(f"{error} {other}, at {frames:,} frames, is whole.") from error


def _read_whole(folder: Path) -> tuple[dict, dict]:
    """Read again where a training has replaced the one file before the other was read."""
    while True:
        files = _files(folder)
        try:
            return _read(folder)
        except CheckpointError:
            time.sleep(0.01)  # between the renames there is neither
            if _files(folder) == files:
                raise


def _files(folder: Path) -> list[tuple[int, int]] | None:
    """Which files a checkpoint consists of, as another one has others; None where they are missing."""
    try:
        found = [(Path(folder) / name).lstat() for name in (FACTS, TENSORS)]
    except OSError:
        return None
    return [(entry.st_ino, entry.st_mtime_ns) for entry in found]


def _read(folder: Path) -> tuple[dict, dict]:
    folder = Path(folder)
    try:
        for name in (FACTS, TENSORS):
            if not stat.S_ISREG((folder / name).lstat().st_mode):  # a pipe would be waited for
                raise CheckpointError(
                    f"{folder}: {name} is a link or no file; expected a file of the checkpoint itself."
                )
        facts = json.loads((folder / FACTS).read_bytes())
        blob = (folder / TENSORS).read_bytes()
    except (OSError, ValueError, RecursionError) as error:  # the last one from JSON that is nested without end
        raise CheckpointError(f"{folder}: the checkpoint cannot be read ({error}).") from error
    if not isinstance(facts, dict) or facts.get("schema") != SCHEMA:
        found = facts.get("schema") if isinstance(facts, dict) else None
        raise CheckpointError(f"{folder}: schema {found!r}, expected {SCHEMA}; another version wrote it.")
    if hashlib.sha256(blob).hexdigest() != facts.get("sha256"):
        raise CheckpointError(f"{folder}: {TENSORS} is truncated or altered, its checksum does not match {FACTS}.")
    try:
        tensors = load(blob)
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:  # types and sizes there are not
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{folder}: {TENSORS} cannot be read ({reason}).") from error
    state, frames = facts.pop("state", None), facts.get("frames")
    whole = isinstance(frames, int) and not isinstance(frames, bool) and 0 <= frames < 2**63
    if not isinstance(state, dict) or not isinstance(facts.get("config"), dict) or not whole:
        raise CheckpointError(f"{folder}: {FACTS} lacks its state, config or frames; expected what a training wrote.")
    try:
        state = unflatten(tensors, state)
    except ValueError as error:
        raise CheckpointError(f"{folder}: {FACTS} and {TENSORS} do not fit each other ({error}).") from error
    if not isinstance(state.get("policy"), dict):
        raise CheckpointError(f"{folder}: {TENSORS} has no policy; expected what a training wrote.")
    return state, facts


def fitting(theirs, mine: dict, what: str, path: str = "") -> dict:
    """The part of a checkpoint's state that is shaped like ``mine``, nested dicts of tensors and plain values.

    Raises:
        CheckpointError: naming the first value that is missing, of another type or shape, or not finite.
    """
    found: dict = {}
    for key, own in mine.items():
        other, name = theirs.get(key) if isinstance(theirs, dict) else None, f"{path}{key}"
        if key == "cuda_rng" and other is None:  # saved without a GPU
            continue
        if isinstance(own, dict):
            found[key] = fitting(other, own, what, f"{name}|")
            continue
        if _kind(other) != _kind(own):
            raise CheckpointError(
                f"The checkpoint's {what} does not fit these settings: {name} is {_kind(other)}, expected {_kind(own)}."
            )
        if isinstance(other, Tensor) and not other.isfinite().all():
            raise CheckpointError(f"The checkpoint's {what} is of no use: {name} holds values that are not finite.")
        found[key] = other
    return found


def _kind(value) -> str:
    """A value's type, for comparing and for messages."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} of shape {tuple(value.shape)}"
    return "missing" if value is None else type(value).__name__


def restore(make: Callable[[], Module], state: dict, what: str) -> Module:
    """The module that ``make()`` makes, with a checkpoint's tensors.

    Sizes are compared before any memory is taken: a config that asks for more than there is cannot fit the tensors.

    Raises:
        CheckpointError: as :func:`fitting`, and for a tensor that the module does not have.
    """
    with torch.device("meta"):
        own = make().state_dict()
    weights = fitting(state, own, what)
    if unknown := sorted(map(str, set(state) - set(own))):
        raise CheckpointError(f"The checkpoint's {what} does not fit these settings: {unknown[0]} is not expected.")
    module = make()
    module.load_state_dict(weights)
    return module
