"""The machine that a command runs on: threads and device."""

import torch
from omegaconf import DictConfig

from pickplace.task.checks import shortened


def use_machine(cfg: DictConfig) -> torch.device:
    """Set the number of threads of a config, and return its device.

    Raises:
        ValueError: for a device that this machine lacks, or a bad number of threads.
    """
    if cfg.threads is not None:
        if not isinstance(cfg.threads, int) or isinstance(cfg.threads, bool) or not 1 <= cfg.threads <= 1024:
            raise ValueError(f"threads={shortened(cfg.threads)}: expected a whole number >= 1 and <= 1024, or null.")
        torch.set_num_threads(cfg.threads)
    return usable_device(cfg.device)


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
        raise ValueError(f"device={shortened(name)}: expected cpu, or cuda on a machine that has it.")
    return device
