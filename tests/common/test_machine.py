import os
import subprocess
import sys

import pytest
import torch

from pickplace.common.machine import use_threads

THREADS = """
import os
import pickplace.cli, torch
from pickplace.common.machine import use_threads
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
use_threads("threads", None)
print(torch.get_num_threads(), os.environ["OMP_WAIT_POLICY"])
"""

FAULTS = """
import resource, torch
from pickplace.common.machine import keep_memory
keep_memory()
faults = []
for _ in range(20):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(2**26, dtype=torch.uint8)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(max(faults[10:]))
"""

TRIM = """
import torch
from pathlib import Path
from pickplace.common import machine

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

machine.keep_memory()
large, small = zip(*[(torch.ones(2**18), torch.ones(8)) for _ in range(300)])  # small ones between hold the heap
del large
kept = resident()
machine.trim_memory()
assert resident() > kept - 2**20  # little enough
machine.KEPT_BYTES = 0
machine.trim_memory()
print(kept - resident())
"""


@pytest.fixture
def threads():
    """Restores the number of threads of this process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs an affinity")
@pytest.mark.parametrize("policy", ["PASSIVE", "ACTIVE"])
def test_command_uses_its_processors_only_and_waits_as_the_user_says(policy):
    given = {} if policy == "PASSIVE" else {"OMP_WAIT_POLICY": policy}
    environment = {key: value for key, value in os.environ.items() if not key.startswith("OMP")} | given
    out = subprocess.run([sys.executable, "-c", THREADS], env=environment, capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["1", policy]


def test_quota_limits_the_default_only(threads, monkeypatch):
    torch.set_num_threads(4)
    monkeypatch.setattr("pickplace.common.machine.cpu_count", lambda: 2)
    use_threads("threads", None)
    assert torch.get_num_threads() == 2
    use_threads("threads", 3)
    assert torch.get_num_threads() == 3
    with pytest.raises(ValueError, match="--threads=0: expected a whole number >= 1"):
        use_threads("--threads", 0)


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_memory_that_was_freed_is_used_again():
    """It has 16,384 pages of 4 KiB; each would be a page fault if it had been returned.

    The first tensors may lie in different places, so some of them fault although memory is kept.
    """
    out = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    assert int(out.stdout) < 1_000


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_much_freed_memory_is_returned():
    out = subprocess.run([sys.executable, "-c", TRIM], capture_output=True, text=True, check=True)
    assert int(out.stdout) > 200 * 2**20
