"""A limit on the time that an answer takes, and the cancellation of a plan that nobody waits for any more."""

import ctypes
import threading
import time


class Interrupt(BaseException):
    """Ends a plan. Not an ``Exception``: code of a user's own planner must not take it for a fault of its own."""


class Deadline:
    """A context in which a thread ends once its time is up, or another thread has cancelled it.

    The interpreter raises :class:`Interrupt` in the thread before its next instruction in Python. Planning is thousands
    of short calls of torch, so that it ends within milliseconds; unlike a check in each call, this costs nothing.

    Args:
        seconds: from now on, not from the beginning of the context: waiting for one's turn counts.
    """

    def __init__(self, seconds: float):
        self.seconds, self._end = seconds, time.monotonic() + seconds
        self._lock, self._thread = threading.Lock(), 0  # 0: none is in the context
        self._is_cancelled = self._is_over = False

    def left(self) -> float:
        """Return the seconds that are left, at least 0."""
        return max(0.0, self._end - time.monotonic())

    def cancel(self) -> None:
        """End the context, or let it not begin; from another thread."""
        self._is_cancelled = True
        self._interrupt()

    def _interrupt(self) -> None:
        with self._lock:
            self._is_over = True
            if self._thread:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread), ctypes.py_object(Interrupt))

    def error(self) -> TimeoutError:
        """Return the error of a context that was ended, in one sentence."""
        if self._is_cancelled:
            return TimeoutError("cancelled: the client has left before its plan was ready.")
        return TimeoutError(f"no plan within {self.seconds:g} s; expected a greater deadline, or a faster planner.")

    def run(self, function):
        """Return what a function returns.

        Raises:
            TimeoutError: if the deadline comes before that, or has come before, or after a cancellation.
        """
        timer = threading.Timer(self.left(), self._interrupt)
        timer.daemon = True
        try:
            try:
                # First, as up to Python 3.11 a thread that starts has the identity of the one that starts it: it would
                # be interrupted instead, and waited for without end.
                timer.start()
                with self._lock:
                    if self._is_over or not self.left():
                        raise Interrupt
                    self._thread = threading.get_ident()
                return function()
            finally:
                with self._lock:
                    thread, self._thread = self._thread, 0
                    if thread:  # what was to be raised, and was not yet, must not hit what the thread does next
                        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), None)
                timer.cancel()
        except Interrupt:
            with self._lock:
                self._thread = 0  # if it came within the lines above
            timer.cancel()
            raise self.error() from None
