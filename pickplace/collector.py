"""Collectors whose state can be saved and restored exactly. The one place that touches private names of TorchRL."""

import signal
import threading
from collections import OrderedDict
from contextlib import contextmanager
from functools import partial

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector

from pickplace.checkpoint import CheckpointError
from pickplace.config import WorkerDied


class ResumableCollector(Collector):
    """A ``Collector`` whose ``state_dict`` also holds the base environment, the carried TensorDict and the process's
    random generator; TorchRL 0.14.1 saves the transforms, the policy and the counters only.

    With it a killed run resumes bit for bit, directly and as the worker of a multi-process collector.
    """

    def start(self, item_seed: int, rng_seed: int | None = None) -> None:
        """Begin the item stream ``item_seed`` with fresh episodes.

        Making a collector steps its environment, so the streams begin here and not at construction. A worker process
        also gets a seed for its own generator.
        """
        if rng_seed is not None:
            torch.manual_seed(rng_seed)
        self.env.set_seed(item_seed)
        self.reset()

    def _setup_compact_obs(self, compact_obs: bool) -> None:
        """Keep every mask once, where it was acted upon, and not as what came next as well; nobody learns from that."""
        super()._setup_compact_obs(compact_obs)
        if not compact_obs:
            masks = [key for key in self.env.observation_spec.keys() if key.endswith("_mask")]  # noqa: SIM118
            self._compact_next_keys = tuple(("next", key) for key in masks)

    def state_dict(self) -> OrderedDict:
        return OrderedDict(
            environment=dict(self.env.base_env.state_dict()),
            transforms=dict(self.env.transform.state_dict()),
            # What the next step reads. Trajectory numbers, in "collector", are drawn from a pool that workers share.
            carried=self._carrier.select(*self.env.observation_spec.keys(), *self.env.done_keys).clone().to_dict(),
            counters={"frames": torch.tensor(self._frames), "iterations": torch.tensor(self._iter)},
            **rng_state(self.env.device),
        )

    def load_state_dict(self, state_dict, **kwargs) -> None:
        self.env.base_env.load_state_dict(state_dict["environment"])
        self.env.transform.load_state_dict(state_dict["transforms"])
        # The carrier has no device of its own, so that tensors would stay where they were loaded.
        carried = TensorDict(state_dict["carried"], batch_size=self.env.batch_size, device=self.env.device)
        self._carrier.update(carried)
        self._frames = int(state_dict["counters"]["frames"])
        self._iter = int(state_dict["counters"]["iterations"])
        set_rng_state(state_dict, self.env.device)


def rng_state(device: torch.device) -> dict[str, torch.Tensor]:
    """The state of the global generators that a process on this device draws from."""
    state = {"rng": torch.get_rng_state()}
    return state | {"cuda_rng": torch.cuda.get_rng_state(device)} if device.type == "cuda" else state


def set_rng_state(state: dict, device: torch.device) -> None:
    """Restore what :func:`rng_state` returned; one that was saved on another device has the CPU's generator only.

    Raises:
        CheckpointError: if no generator is ever in that state.
    """
    try:
        torch.set_rng_state(state["rng"].cpu())
        if device.type == "cuda" and "cuda_rng" in state:
            torch.cuda.set_rng_state(state["cuda_rng"].cpu(), device)
    except RuntimeError as error:
        raise CheckpointError("The checkpoint's random generator is of no use: it is in no valid state.") from error


def ignore_signals() -> None:
    """Leave Ctrl-C and SIGTERM, which terminals and schedulers send to workers too, to the main process: it finishes
    the batch, saves, and closes the workers."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def watched(collector):
    """While inside, a worker process that dies raises an error in the main thread at once, whatever it waits for.

    TorchRL 0.14.1 looks after its workers between waits only, and then ends them by a signal that ours ignore.

    Raises:
        WorkerDied: saying which worker died, and how; the other ones are killed.
    """
    workers = getattr(collector, "procs", [])

    def look(*_):
        dead = [number for number, worker in enumerate(workers) if not worker.is_alive()]
        if dead:  # first of all one that was killed: others may have ended because of it
            number = min(dead, key=lambda number: workers[number].exitcode == 0)
            code = workers[number].exitcode
            # Loggers and finalizers swallow what is raised while they run, so it is said again until we have left.
            again = threading.Timer(0.5, signal.pthread_kill, (threading.main_thread().ident, signal.SIGCHLD))
            again.daemon = True
            again.start()
            raise WorkerDied(f"collector worker {number + 1} of {len(workers)} has died (exit code {code}).")

    previous = signal.signal(signal.SIGCHLD, look)
    try:
        try:
            look()
            yield
        except (OSError, EOFError, RuntimeError):
            for worker in workers:  # a broken pipe may tell of a death before the signal does
                worker.join(0.5)
            look()
            raise
    except WorkerDied:
        signal.signal(signal.SIGCHLD, previous)
        for worker in workers:
            worker.kill()
            worker.join()
        raise
    finally:
        signal.signal(signal.SIGCHLD, previous)


def single(make_env, policy, num_envs: int, rollout_length: int, seed: int) -> Collector:
    """One batch of environments in this process (config ``collector=single``).

    Args:
        make_env: ``make_env(first_episode, num_envs)`` builds an environment for a share of the slots.
        policy: the collection policy, reading and writing TensorDicts.
        num_envs: number of environment slots, over all processes.
        rollout_length: steps of each slot in a batch.
        seed: seed of the item stream.
    """
    collector = ResumableCollector(
        make_env(0, num_envs),
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=-1,  # the training loop decides; a limit here would close the environment at the last batch
        track_traj_ids=False,  # nobody reads them, and they cost 15%
        trust_policy=True,
        auto_register_policy_transforms=False,  # the policy needs none; saying so silences a warning
    )
    collector.map_fn("start", [(seed,)])
    return collector


def multi_sync(make_env, policy, num_envs: int, rollout_length: int, seed: int, workers: int = 2) -> MultiSyncCollector:
    """Worker processes, each with its share of the slots (config ``collector=multi_sync``).

    Args: as :func:`single`, and ``workers``, the number of processes; it must divide ``num_envs``.
    """
    if not isinstance(workers, int) or workers < 1 or num_envs % workers:
        raise ValueError(f"collector.workers={workers}: expected a divisor of env.num_envs={num_envs}.")
    share = num_envs // workers
    collector = MultiSyncCollector(
        [partial(make_env, worker * share, share) for worker in range(workers)],
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=-1,
        cat_results=0,
        collector_class=ResumableCollector,
        trust_policy=True,
        use_buffers=True,
        auto_register_policy_transforms=False,
        init_fn=ignore_signals,
    )
    # Each worker draws its own actions; large odd steps keep the generators apart from those of seed + 1.
    collector.map_fn("start", [(seed, seed * 1_000_003 + worker + 1) for worker in range(workers)])
    return collector
