"""Origin of a result: versions, commit, and the start of a training."""

import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
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
    """Return the commit of the checkout that the package runs from, with ``+`` if files outside docs/ are modified.

    None without a checkout.
    """
    root = Path(__file__).resolve().parents[2]

    def git(*arguments):
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    with suppress(OSError, subprocess.CalledProcessError):
        if (root / ".git").exists():
            modified = git("status", "--porcelain", "-uno", "--", ".", ":!docs")
            return git("rev-parse", "HEAD") + ("+" if modified else "")
    return None


def first_steps(cfg: dict) -> dict[str, str | None]:
    """Return the start of a run, from its saved config, which may be invalid.

    Returns:
        ``warm_start``, the name of the planner that the run imitated first, and ``first_weights``, the path of the
        checkpoint with its first weights; None without one.
    """
    warm_start = _group(cfg, "warm_start")
    name = _group(warm_start, "teacher").get("_target_") if warm_start.get("frames") else None
    path = warm_start.get("weights")
    return {
        "warm_start": name if is_name(name) else None,
        "first_weights": short_text(path) if isinstance(path, str) else None,
    }


def _group(cfg: Mapping, key: str) -> Mapping:
    return group if isinstance(group := cfg.get(key), Mapping) else {}
