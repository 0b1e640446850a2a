"""Find checkpoints and read their facts, without torch."""

import json
from pathlib import Path
from typing import Any

from pickplace.common.files import read_file
from pickplace.common.validate import is_whole

PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"  # weights that the package ships
TENSORS, FACTS = "state.safetensors", "state.json"
PREVIOUS = "previous"  # the checkpoint before checkpoints/last, beside it
MAX_BYTES = {FACTS: 2**25, TENSORS: 2**32}  # greatest size of each file


class CheckpointError(ValueError):
    """Error of a checkpoint that is missing, damaged or does not fit; the message is one sentence."""


def locate(path, prefer: str = "best", key: str | None = None) -> Path:
    """Return the checkpoint folder at a path that a user gives.

    Args:
        path: a run folder (then its ``checkpoints/<prefer>``), a checkpoint, or ``pretrained/<name>``: weights that
            the package ships, unless the working directory has a folder of that name.
        prefer: ``"best"``; or ``"last"`` to resume a run. A run killed before its first ``last`` resumes from ``best``.
        key: the setting that names the path, for messages; None: ``checkpoint``, or ``resume`` with ``"last"``.

    Raises:
        CheckpointError: if there is no checkpoint.
    """
    key = key or ("resume" if prefer == "last" else "checkpoint")
    parts = Path(path).parts
    if len(parts) == 2 and parts[0] == "pretrained" and not Path(path).exists():
        shipped = {facts.parent.name: facts.parent for facts in sorted(PRETRAINED.glob(f"*/{FACTS}"))}
        if parts[1] in shipped:
            return shipped[parts[1]]
        names = ", ".join(f"pretrained/{name}" for name in shipped)
        raise CheckpointError(f"{key}={str(path)!r}: the package ships no such weights; expected {names}.")
    path = Path(path).absolute()
    saved, preferred = path / "checkpoints", ("last", "best") if prefer == "last" else (prefer,)
    for folder in (*map(saved.joinpath, preferred), path):
        for candidate in (folder, folder.with_name(f".{folder.name}.old")):
            if (candidate / FACTS).is_file():
                return candidate
    others = [saved / name for name in ("last", PREVIOUS) if (saved / name / FACTS).is_file()]
    missing = (
        f"no {prefer} checkpoint there; expected {key}={others[0]}."
        if others
        else ("no checkpoint there; expected a run folder, or one of its checkpoints: best, last or previous.")
    )
    raise CheckpointError(f"{key}={str(path)!r}: {missing}")


def read_facts(path, prefer: str = "best") -> dict:
    """Return the facts of the checkpoint that :func:`locate` finds, unchecked; empty if they cannot be read."""
    try:
        facts = json.loads(read_file(locate(path, prefer) / FACTS, MAX_BYTES[FACTS]))
    except (CheckpointError, OSError, ValueError, RecursionError):
        return {}
    return facts if are_facts(facts) else {}


def are_facts(facts) -> bool:
    """Return whether the content of a ``state.json`` has valid frames and a config."""
    frames: Any = facts.get("frames") if isinstance(facts, dict) else None
    return is_whole(frames) and 0 <= frames < 2**63 and isinstance(facts.get("config"), dict)
