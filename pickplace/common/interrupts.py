"""Handling of Ctrl-C during imports, which take seconds: libraries in C may not survive an exception then."""

import os
import signal
from importlib import import_module
from types import ModuleType


def import_quietly(name: str) -> ModuleType:
    """Import a module; Ctrl-C meanwhile ends the process without a message."""
    before = set_interrupt_handler(end_process)
    try:
        return import_module(name)
    finally:
        set_interrupt_handler(before)


def set_interrupt_handler(handler):
    """Set the handler of Ctrl-C, unless it is ignored, and return the earlier one."""
    if (before := signal.getsignal(signal.SIGINT)) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    return before


def end_process(*_) -> None:
    """End the process at once, with the exit code of Ctrl-C."""
    os._exit(130)
