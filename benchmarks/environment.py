"""Measure environment steps a second on one core, with the full joint mask, against Jumanji's BinPack-v2.

python benchmarks/environment.py    (pip install jumanji; without it, only ours is measured)

Both environments are natively batched, take random feasible actions and reset by themselves; the choice of the actions
is not timed. Jumanji's task differs: items of any size go into empty maximal spaces, and there is no end effector. So
the ratio compares the cost of a step, not the quality of a packing.
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import sys  # noqa: E402
import time  # noqa: E402

import torch  # noqa: E402
from common import save, spread, use_one_core  # noqa: E402

from pickplace import PickPlaceEnv  # noqa: E402
from pickplace.planners.heuristics import RandomFeasible  # noqa: E402

BATCHES = (64, 256, 1024)
STEPS = 100


class Ours:
    """``PickPlaceEnv`` through ``step_and_maybe_reset``."""

    def __init__(self, batch: int):
        self.env = PickPlaceEnv(support="half", num_envs=batch)
        self.planner = RandomFeasible(self.env.cell)
        self.state = self.env.reset()

    def time_step(self) -> float:
        self.state["action"] = self.planner.decide(self.state)
        start = time.perf_counter()
        _, self.state = self.env.step_and_maybe_reset(self.state)
        return (time.perf_counter() - start) * 1e3


class Jumanji:
    """BinPack-v2, jitted and vmapped, with auto-reset."""

    def __init__(self, batch: int):
        import jax
        import jumanji
        from jumanji.wrappers import AutoResetWrapper, VmapWrapper

        self.jax = jax
        env = VmapWrapper(AutoResetWrapper(jumanji.make("BinPack-v2")))
        self.step = jax.jit(env.step)
        self.key = jax.random.PRNGKey(0)
        self.state, timestep = jax.jit(env.reset)(jax.random.split(self.key, batch))
        self.mask = timestep.observation.action_mask  # [N, spaces, items]

        def choose(key, mask):
            flat = mask.reshape(len(mask), -1)
            index = jax.random.categorical(key, jax.numpy.where(flat, 0.0, -1e9), axis=-1)
            return jax.numpy.stack([index // mask.shape[2], index % mask.shape[2]], -1)

        self.choose = jax.jit(choose)

    def time_step(self) -> float:
        self.key, key = self.jax.random.split(self.key)
        action = self.jax.block_until_ready(self.choose(key, self.mask))
        start = time.perf_counter()
        self.state, timestep = self.jax.block_until_ready(self.step(self.state, action))
        passed = (time.perf_counter() - start) * 1e3
        self.mask = timestep.observation.action_mask
        return passed


def main() -> None:
    use_one_core()
    makers = {"pickplace": Ours}
    try:
        import jumanji

        makers["jumanji"] = Jumanji
        peer = f"jumanji {jumanji.__version__}"
    except ImportError:
        peer = None
        sys.stderr.write("jumanji is not installed: the peer is skipped (pip install jumanji)\n")
    result = {"peer": peer, "steps": STEPS, "batches": {}}
    for batch in BATCHES:
        worlds = {name: maker(batch) for name, maker in makers.items()}
        times = {name: [] for name in worlds}
        for step in range(STEPS + 5):
            for name, world in worlds.items():
                passed = world.time_step()
                if step >= 5:
                    times[name].append(passed)
        row = {name: spread(values) for name, values in times.items()}
        for figures in row.values():
            figures["steps_per_second"] = round(batch / figures["ms"] * 1e3)
        if peer:
            row["ratio"] = row["pickplace"]["steps_per_second"] / row["jumanji"]["steps_per_second"]
        result["batches"][batch] = row
    save("environment", result)


if __name__ == "__main__":
    torch.manual_seed(0)
    main()
