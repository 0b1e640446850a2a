"""A plan ends at its deadline, or when it is cancelled, whenever that is."""

import sys
import threading
import time

import pytest

from pickplace.serve.deadline import Deadline


def wait_a_minute():
    end = time.monotonic() + 60
    while time.monotonic() < end:
        pass


def test_a_cancellation_as_soon_as_a_plan_begins_ends_it():
    """Not a thread that starts at the same moment: it would be waited for without end."""
    switch, ended = sys.getswitchinterval(), []

    def plan(deadline):
        with pytest.raises(TimeoutError, match="cancelled"):
            deadline.run(wait_a_minute)
        ended.append(deadline)

    def cancel(deadline):
        while not deadline._thread:
            pass
        deadline.cancel()

    sys.setswitchinterval(1e-6)
    try:
        for _ in range(20):
            deadline = Deadline(100)
            threads = [threading.Thread(target=work, args=(deadline,), daemon=True) for work in (cancel, plan)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(20)
            assert ended.pop() is deadline
    finally:
        sys.setswitchinterval(switch)


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_a_plan_whose_time_is_up_does_not_begin(is_cancelled):
    deadline = Deadline(100 if is_cancelled else 0.001)
    deadline.cancel() if is_cancelled else time.sleep(0.01)
    with pytest.raises(TimeoutError, match="cancelled" if is_cancelled else "no plan within 0.001 s"):
        deadline.run(lambda: pytest.fail("it began"))
    assert Deadline(100).run(lambda: "plan") == "plan"
