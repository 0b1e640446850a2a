"""Origin of a result: versions, commit, and what a training began with."""

import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path

import tensordict
import torch
import torchrl

import pickplace
from pickplace.common.validate import is_name, short_text


def versions() -> dict[str, str]:
    """Return the versions of the software behind a result."""
    return {
        "pickplace": pickplace.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
    }


def commit() -> str | None:
    """Return the commit of the checkout that the package runs from, ``+`` if files outside docs/ are modified.

    None without a checkout.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None

    def git(*arguments):
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        modified = git("status", "--porcelain", "-uno", "--", ".", ":!docs").strip()
        return git("rev-parse", "HEAD").strip() + ("+" if modified else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def imitated_planner(cfg: dict) -> str | None:
    """Return the name of the planner that a run with this saved config, unchecked, imitated first, or None."""
    warm_start = cfg.get("warm_start")
    if not isinstance(warm_start, Mapping) or not warm_start.get("frames"):
        return None
    teacher = warm_start.get("teacher")
    name = teacher.get("_target_") if isinstance(teacher, Mapping) else None
    return name if is_name(name) else None


def first_weights(cfg: dict) -> str | None:
    """Return the checkpoint with whose weights a run began, or None; ``cfg`` is its saved config, unchecked."""
    warm_start = cfg.get("warm_start")
    path = warm_start.get("weights") if isinstance(warm_start, Mapping) else None
    return short_text(path) if isinstance(path, str) else None
