"""The machine that a command runs on: threads and device."""

import torch
from loky import cpu_count
from omegaconf import DictConfig

from pickplace.common.validate import short_text, whole_number


def use_machine(cfg: DictConfig) -> torch.device:
    """Set the number of threads of a config, and return its device.

    Raises:
        ValueError: for a device that this machine lacks, or a bad number of threads.
    """
    use_threads("threads", cfg.threads)
    return usable_device(cfg.device)


def use_threads(key: str, threads: int | None) -> None:
    """Set the number of threads of this process; None: as many as it may use, by its affinity and its cgroup's quota.

    Raises:
        ValueError: naming the ``key``, for a bad number.
    """
    default = min(torch.get_num_threads(), cpu_count())
    torch.set_num_threads(default if threads is None else whole_number(key, threads, most=1024))


def usable_device(name: str) -> torch.device:
    """Return the device of that name.

    Raises:
        ValueError: if this machine lacks it.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
        usable = device.type in ("cpu", "cuda")
    except (RuntimeError, TypeError, AssertionError, ValueError, OverflowError):
        usable = False
    if not usable:
        raise ValueError(f"device={short_text(name)}: expected cpu, or cuda on a machine that has it.")
    return device
