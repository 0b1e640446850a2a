"""Limit the time that an answer may take, and cancel a plan that nobody waits for any more."""

import ctypes
import threading
import time


class Interrupt(BaseException):
    """End of a plan. Not an ``Exception``: a user's planner must not catch it as an error of its own."""


class Deadline:
    """A limit on the time of a function call, which another thread can also cancel.

    The interpreter raises :class:`Interrupt` in the thread before its next instruction in Python. Planning is thousands
    of short calls of torch, so it ends within milliseconds. Unlike a check in each call, this costs nothing.

    Args:
        seconds: time from now on, not from the start of the call: waiting in the queue counts.
    """

    def __init__(self, seconds: float):
        self.seconds, self._end = seconds, time.monotonic() + seconds
        self._lock, self._thread = threading.Lock(), 0  # 0: no thread runs a function
        self._is_cancelled = self._is_over = False

    def left(self) -> float:
        """Return the seconds that are left, at least 0."""
        return max(0.0, self._end - time.monotonic())

    def cancel(self) -> None:
        """End the call, or keep it from starting; another thread calls this."""
        self._is_cancelled = True
        self._interrupt()

    def _interrupt(self) -> None:
        with self._lock:
            self._is_over = True
            if self._thread:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread), ctypes.py_object(Interrupt))

    def error(self) -> TimeoutError:
        """Return the error of a call that was ended, in one sentence."""
        if self._is_cancelled:
            return TimeoutError("cancelled: the client has left before its plan was ready.")
        return TimeoutError(f"no plan within {self.seconds:g} s; expected a greater deadline, or a faster planner.")

    def run(self, function):
        """Call a function, and return its result.

        Raises:
            TimeoutError: if the deadline comes first or has passed already, or after a cancellation.
        """
        timer = threading.Timer(self.left(), self._interrupt)
        timer.daemon = True
        try:
            try:
                # Before the thread is noted: up to Python 3.11, a new thread has its parent's identity while it starts,
                # so the timer would be interrupted instead, and then waited for without end.
                timer.start()
                with self._lock:
                    if self._is_over or not self.left():
                        raise Interrupt
                    self._thread = threading.get_ident()
                return function()
            finally:
                with self._lock:
                    thread, self._thread = self._thread, 0
                    if thread:  # a pending Interrupt must not hit the thread's next task
                        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), None)
                timer.cancel()
        except Interrupt:
            with self._lock:
                self._thread = 0  # if Interrupt came within the lines above
            timer.cancel()
            raise self.error() from None
