"""Collectors whose state can be saved and restored exactly. The one place that touches private names of TorchRL."""

import signal
import sys
import threading
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import contextmanager
from functools import partial

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.collectors.distributed import RayCollector

from pickplace.runs.checkpoint import CheckpointError
from pickplace.runs.errors import WorkerDied, missing_extra


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


class ResumableRayCollector(RayCollector):
    """A ``RayCollector`` of `ResumableCollector` actors: their state by worker, as a multi-process collector gives it,
    one batch ``[num_envs, rollout_length]``, and an error in one sentence when an actor is gone."""

    def iterator(self):
        with self._watched():
            for batch in super().iterator():
                yield batch.flatten(0, 1)  # TorchRL 0.14.1 stacks: [workers, share, rollout_length]

    def update_policy_weights_(self, weights: TensorDict) -> None:
        # Through Ray's own store, to each worker's `Collector`. TorchRL's weight synchronisation opens connections
        # of its own, for which one more process has to start within 60 s: more than a busy machine gives.
        import ray

        reference = ray.put(weights)
        self.map_fn("update_policy_weights_", [(reference,)] * self.num_collectors)

    def map_fn(self, *args, **kwargs) -> list:
        with self._watched():
            return super().map_fn(*args, **kwargs)

    def state_dict(self) -> OrderedDict:
        with self._watched():
            return OrderedDict((f"worker{worker}", state) for worker, state in enumerate(super().state_dict()))

    def load_state_dict(self, state_dict, **kwargs) -> None:
        with self._watched():
            super().load_state_dict([state_dict[f"worker{worker}"] for worker in range(self.num_collectors)])

    @contextmanager
    def _watched(self):
        from ray.exceptions import RayActorError

        try:
            yield
        except RayActorError as error:
            raise WorkerDied("a Ray worker of the collector has died.") from error


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

    TorchRL 0.14.1 looks after its workers between waits only. It ends them by a signal that ours ignore, then closes
    them: an error while they run, and a closed one tells nothing more.

    Raises:
        WorkerDied: saying which worker died, and how; the other ones are killed.
    """
    workers = getattr(collector, "procs", [])

    def open_ones() -> list:
        return [worker for worker in workers if not worker._closed]

    def look(signum=None, _=None):
        dead = [number for number, worker in enumerate(workers) if not worker._closed and not worker.is_alive()]
        if dead:  # first of all one that was killed: others may have ended because of it
            number = min(dead, key=lambda number: workers[number].exitcode == 0)
            code = workers[number].exitcode
            # Loggers and finalizers swallow what is raised while they run, so it is said again until we have left.
            again = threading.Timer(0.5, signal.pthread_kill, (threading.main_thread().ident, signal.SIGCHLD))
            again.daemon = True
            again.start()
            if signum and sys.exc_info()[1]:
                return  # an error is on its way out, maybe of this death: do not break in on its cleaning up
            raise WorkerDied(f"collector worker {number + 1} of {len(workers)} has died (exit code {code}).")

    previous = signal.signal(signal.SIGCHLD, look)
    try:
        try:
            look()
            yield
        except (OSError, EOFError, RuntimeError, ValueError):
            for worker in open_ones():  # a broken pipe may tell of a death before the signal does
                worker.join(0.5)
            look()
            raise
    except WorkerDied:
        signal.signal(signal.SIGCHLD, previous)
        for worker in open_ones():
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
    return _started(collector, [(seed,)])


def multi_sync(make_env, policy, num_envs: int, rollout_length: int, seed: int, workers: int = 2) -> MultiSyncCollector:
    """Worker processes, each with its share of the slots (config ``collector=multi_sync``).

    Args: as :func:`single`, and ``workers``, the number of processes; it must divide ``num_envs``.
    """
    share = _share(num_envs, workers)
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
    return _started(collector, _seeds(seed, workers))


def ray(
    make_env, policy, num_envs: int, rollout_length: int, seed: int, workers: int = 2, address: str = "local"
) -> ResumableRayCollector:
    """Worker processes of a Ray cluster, each with its share of the slots (config ``collector=ray``); needs the extra
    ``pickplace[ray]``.

    Args: as :func:`multi_sync`, and ``address``: ``local`` starts a Ray of this run's own, ``auto`` or ``host:port``
        joins a cluster.

    Raises:
        ValueError: without the extra, with a policy on a GPU, or workers that do not divide the slots.
    """
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise missing_extra("collector", "ray") from error
    if any(parameter.is_cuda for parameter in policy.parameters()):
        raise ValueError("collector=ray: its workers have no GPU; expected device=cpu, or collector=single.")
    share = _share(num_envs, workers)
    # A Ray of our own has room for the workers, however few cores there are; a cluster knows what it has.
    room = {"num_cpus": workers} if address == "local" else {}
    collector = ResumableRayCollector(
        [partial(make_env, worker * share, share) for worker in range(workers)],
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=sys.maxsize,  # -1 would end it before its first batch
        sync=True,
        collector_class=ResumableCollector,
        collector_kwargs=[
            {"track_traj_ids": False, "auto_register_policy_transforms": False} for _ in range(workers)
        ],
        trust_policy=True,
        weight_sync_schemes={},
        remote_configs={"num_cpus": 1, "num_gpus": 0},
        ray_init_config={
            "address": address, "include_dashboard": False, "logging_level": "warning", "log_to_driver": False, **room
        },
    )  # fmt: skip
    collector._weight_sync_initialized = True  # silences a warning on the scheme that there is none of
    return _started(collector, _seeds(seed, workers))


def _started(collector, seeds: Sequence[tuple[int, ...]]):
    """The collector with each worker's streams begun, or nothing left of it: a process would wait for its workers."""
    try:
        collector.map_fn("start", seeds)
    except BaseException:
        collector.shutdown()
        raise
    return collector


def _share(num_envs: int, workers: int) -> int:
    """How many of the slots each worker has."""
    if not isinstance(workers, int) or workers < 1 or num_envs % workers:
        raise ValueError(f"collector.workers={workers}: expected a divisor of env.num_envs={num_envs}.")
    return num_envs // workers


def _seeds(seed: int, workers: int) -> list[tuple[int, int]]:
    """Each worker's item stream and generator: all draw the same items, and actions of their own; large odd steps keep
    the generators apart from those of ``seed + 1``."""
    return [(seed, (seed * 1_000_003 + worker + 1) % 2**63) for worker in range(workers)]
