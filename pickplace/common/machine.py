"""The machine that a command runs on: threads, memory and device."""

import ctypes
import os
import sys
from contextlib import suppress
from pathlib import Path

import torch
from loky import cpu_count
from omegaconf import DictConfig

from pickplace.common.validate import short_text, whole_number

KEPT_BYTES = 2**31  # memory of the process from which on freed memory is returned


def use_machine(cfg: DictConfig) -> torch.device:
    """Set the number of threads of a config, let the process keep its memory, and return its device.

    Raises:
        ValueError: for a device that this machine lacks, or a bad number of threads.
    """
    use_threads("threads", cfg.threads)
    keep_memory()
    return usable_device(cfg.device)


def use_threads(key: str, threads: int | None) -> None:
    """Set the number of threads of this process; None: as many as it may use, by its affinity and its cgroup's quota.

    Raises:
        ValueError: naming the ``key``, for a bad number.
    """
    usable = min(torch.get_num_threads(), cpu_count()) if threads is None else whole_number(key, threads, most=1024)
    torch.set_num_threads(usable)


def keep_memory() -> None:
    """Let glibc keep freed memory: returning it at each step and getting it again took a fifth of a training."""
    most, m_trim_threshold, m_mmap_max = 2**31 - 1, -1, -4  # of <malloc.h>
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            libc = ctypes.CDLL(None)
            libc.mallopt(m_mmap_max, 0)
            libc.mallopt(m_trim_threshold, most)


def trim_memory() -> None:
    """Return freed memory to the system if the process has more than :data:`KEPT_BYTES`.

    Blocks of many sizes fragment the heap: with :func:`keep_memory` alone it grows without end.
    """
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > KEPT_BYTES:
            with suppress(OSError, AttributeError):  # another C library
                ctypes.CDLL(None).malloc_trim(0)


def usable_device(name: str) -> torch.device:
    """Return the device of that name.

    Raises:
        ValueError: if this machine lacks it.
    """
    with suppress(RuntimeError, TypeError, AssertionError, ValueError, OverflowError):
        if torch.empty(0, device=name).device.type in ("cpu", "cuda"):
            return torch.device(name)
    raise ValueError(f"device={short_text(name)}: expected cpu, or cuda on a machine that has it.")
