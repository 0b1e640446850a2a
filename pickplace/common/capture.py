"""Capture of GPU work: a CUDA graph repeats the same work, so that its shapes and its course must not depend on data.

Code that skips work where there is none to do asks :func:`any_of`. Code with another way for a capture asks
:func:`is_capturing`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

_CAPTURING = ContextVar("capturing", default=False)
_COPIES = WeakTensorKeyDictionary()  # constant -> its copy by device


@contextmanager
def capturing() -> Iterator[None]:
    """Within this context, code has fixed shapes and reads nothing back from the device."""
    token = _CAPTURING.set(True)
    try:
        yield
    finally:
        _CAPTURING.reset(token)


def is_capturing() -> bool:
    """Return whether shapes must be fixed, and nothing may be read back from the device."""
    return _CAPTURING.get()


def any_of(mask: Tensor) -> bool:
    """Return whether any of a mask is true; always true in a capture, which cannot look."""
    return is_capturing() or bool(mask.any())


def constant_on(constant: Tensor, device: torch.device) -> Tensor:
    """Return a tensor that never changes on a device. Its copy is kept: to copy it in each step would make a GPU wait,
    and a capture must not copy from the CPU at all."""
    if constant.device == device:
        return constant
    copies = _COPIES.setdefault(constant, {})
    if device not in copies:
        copies[device] = constant.to(device)
    return copies[device]
