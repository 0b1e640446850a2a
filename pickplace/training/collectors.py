"""Collectors whose state is saved and restored exactly. Only they and the loss of PPO use private names of TorchRL."""

import signal
import sys
import threading
from collections.abc import Collection, Sequence
from contextlib import contextmanager
from functools import partial

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.collectors.distributed import RayCollector

from pickplace.common.errors import WorkerDied, require_extra
from pickplace.common.validate import expect, reword_errors, whole_number
from pickplace.runs.locate import CheckpointError
from pickplace.runs.resume import STOP_SIGNALS


class ResumableCollector(Collector):
    """A ``Collector`` that resumes bit for bit, in this process or as the worker of a multi-process collector.

    Its ``state_dict`` also holds the base environment, the carried TensorDict and the process's random generator;
    TorchRL 0.14.1 saves only the transforms, the policy and the counters.

    Args:
        next_keys: masks that are stored under ``next``, too.
        *args, **kwargs: of ``Collector``.
    """

    def __init__(self, *args, next_keys: Collection[str] = (), **kwargs):
        self.next_keys = next_keys
        super().__init__(*args, **kwargs)

    def start(self, item_seed: int, rng_seed: int | None = None) -> None:
        """Begin the item stream ``item_seed`` with new episodes.

        Constructing a collector steps its environment, so the streams begin here and not at construction.

        Args:
            item_seed: seed of the item stream.
            rng_seed: seed of the process's own generator, for a worker process.
        """
        if rng_seed is not None:
            torch.manual_seed(rng_seed)
        self.env.set_seed(item_seed)
        self.reset()

    def _setup_compact_obs(self, compact_obs: bool) -> None:
        """Store each mask only in the frame that used it, not again under ``next``, except :attr:`next_keys`."""
        super()._setup_compact_obs(compact_obs)
        if not compact_obs:
            masks = {key for key in self.env.observation_spec.keys() if key.endswith("_mask")}  # noqa: SIM118
            self._compact_next_keys = tuple(("next", key) for key in sorted(masks.difference(self.next_keys)))

    def state_dict(self) -> dict:
        return {
            "environment": dict(self.env.base_env.state_dict()),
            "transforms": dict(self.env.transform.state_dict()),
            # The input of the next step; not "collector", whose trajectory numbers come from a pool that workers share.
            "carried": self._carrier.select(*self.env.observation_spec.keys(), *self.env.done_keys).clone().to_dict(),
            "counters": {"frames": torch.tensor(self._frames), "iterations": torch.tensor(self._iter)},
            **rng_state(self.env.device),
        }

    def load_state_dict(self, state_dict, **kwargs) -> None:
        self.env.base_env.load_state_dict(state_dict["environment"])
        self.env.transform.load_state_dict(state_dict["transforms"])
        # The carrier has no device, so tensors would stay on the device on which they were loaded.
        self._carrier.update(TensorDict(state_dict["carried"], batch_size=self.env.batch_size, device=self.env.device))
        self._frames, self._iter = (int(state_dict["counters"][key]) for key in ("frames", "iterations"))
        set_rng_state(state_dict, self.env.device)


@contextmanager
def _ray_errors():
    from ray.exceptions import RayActorError

    with reword_errors(RayActorError, lambda _: WorkerDied("a Ray worker of the collector has died.")):
        yield


class ResumableRayCollector(RayCollector):
    """A ``RayCollector`` of :class:`ResumableCollector` actors.

    Like ``MultiSyncCollector`` it has a state per worker and batches ``[num_envs, rollout_length]``; a dead actor
    raises :class:`WorkerDied`.
    """

    def iterator(self):
        with _ray_errors():
            for batch in super().iterator():
                yield batch.flatten(0, 1)  # TorchRL 0.14.1 stacks: [workers, share, rollout_length]

    def update_policy_weights_(self, weights: TensorDict) -> None:
        # Sent through Ray's object store. TorchRL's weight synchronisation opens its own connections, for which
        # another process must start within 60 s, which fails on a busy machine.
        import ray

        self.map_fn("update_policy_weights_", [(ray.put(weights),)] * self.num_collectors)

    @_ray_errors()
    def map_fn(self, *args, **kwargs) -> list:
        return super().map_fn(*args, **kwargs)

    @_ray_errors()
    def state_dict(self) -> dict:
        return {f"worker{worker}": state for worker, state in enumerate(super().state_dict())}

    @_ray_errors()
    def load_state_dict(self, state_dict, **kwargs) -> None:
        super().load_state_dict([state_dict[f"worker{worker}"] for worker in range(self.num_collectors)])


def rng_state(device: torch.device) -> dict[str, torch.Tensor]:
    """Return the state of the global random generators of a process on this device."""
    return {
        "rng": torch.get_rng_state(),
        **({"cuda_rng": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {}),
    }


def set_rng_state(state: dict, device: torch.device) -> None:
    """Restore the state that :func:`rng_state` returned; a state saved on a CPU leaves the GPU's generator alone.

    Raises:
        CheckpointError: if the state is not valid.
    """
    with reword_errors(
        RuntimeError,
        lambda _: CheckpointError("The checkpoint's random generator is of no use: its state is not valid."),
    ):
        torch.set_rng_state(state["rng"].cpu())
        if device.type == "cuda" and "cuda_rng" in state:
            torch.cuda.set_rng_state(state["cuda_rng"].cpu(), device)


def ignore_signals() -> None:
    """Ignore Ctrl-C, SIGTERM and SIGHUP in a worker process.

    Terminals and schedulers send them to workers too; the main process finishes the batch, saves, and closes the
    workers.
    """
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def watch_workers(collector):
    """Raise an error in the main thread as soon as a worker process dies, whatever the main thread waits for.

    TorchRL 0.14.1 checks its workers only between waits. It ends them by a signal that our workers ignore,
    then closes them. So a worker that has ended is an error only if it is not closed.

    Raises:
        WorkerDied: naming the worker and its exit code; the other workers are killed.
    """
    workers = getattr(collector, "procs", [])

    def open_workers() -> list:
        return [worker for worker in workers if not worker._closed]

    def check(signum=None, _=None):
        if dead := [worker for worker in open_workers() if not worker.is_alive()]:
            # Name a killed worker first, which has a negative code: others may have ended or failed because of it.
            worker = min(dead, key=lambda worker: (worker.exitcode >= 0, worker.exitcode == 0))
            # Loggers and finalizers swallow an error raised while they run, so repeat it until this context ends.
            repeat = threading.Timer(0.5, signal.pthread_kill, (threading.main_thread().ident, signal.SIGCHLD))
            repeat.daemon = True
            repeat.start()
            if signum and sys.exc_info()[1]:
                return  # another error, perhaps of this death, is being handled: do not interrupt its cleanup
            raise WorkerDied(
                f"collector worker {1 + workers.index(worker)} of {len(workers)} has died "
                f"(exit code {worker.exitcode})."
            )

    previous = signal.signal(signal.SIGCHLD, check)
    try:
        try:
            check()
            yield
        except (OSError, EOFError, RuntimeError, ValueError):
            for worker in open_workers():  # a broken pipe may be noticed before the signal of the death
                worker.join(0.5)
            check()
            raise
        finally:
            signal.signal(signal.SIGCHLD, previous)
    except WorkerDied:
        for worker in open_workers():
            worker.kill()
            worker.join()
        raise


def single(make_env, policy, num_envs: int, rollout_length: int, seed: int, next_keys=()) -> Collector:
    """Make a collector of one batch of environments in this process (config ``collector=single``).

    Args:
        make_env: ``make_env(first_episode, num_envs)`` makes an environment for a share of the slots.
        policy: the collection policy, reading and writing TensorDicts.
        num_envs: number of environment slots over all processes.
        rollout_length: steps of each slot in a batch.
        seed: seed of the item stream.
        next_keys: masks that the batch holds under ``next``, too.
    """
    collector = ResumableCollector(
        make_env(0, num_envs),
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=-1,  # the training loop ends itself; a limit would close the environment at the last batch
        track_traj_ids=False,  # nothing reads them, and they cost 15%
        trust_policy=True,
        auto_register_policy_transforms=False,  # the policy needs none; the explicit value silences a warning
        next_keys=next_keys,
    )
    return _started(collector, [(seed,)])


def multi_sync(
    make_env, policy, num_envs: int, rollout_length: int, seed: int, next_keys=(), workers: int = 2
) -> MultiSyncCollector:
    """Make a collector of worker processes, each with its share of the slots (config ``collector=multi_sync``).

    Args: as in :func:`single`, and ``workers``, the number of processes; it must divide ``num_envs``.
    """
    collector = MultiSyncCollector(
        _shares(make_env, num_envs, workers, 64),
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=-1,
        cat_results=0,
        collector_class=partial(ResumableCollector, next_keys=next_keys),
        trust_policy=True,
        use_buffers=True,
        auto_register_policy_transforms=False,
        init_fn=ignore_signals,
    )
    return _started(collector, _seeds(seed, workers))


def ray(
    make_env,
    policy,
    num_envs: int,
    rollout_length: int,
    seed: int,
    next_keys=(),
    workers: int = 2,
    address: str = "local",
) -> ResumableRayCollector:
    """Make a collector of worker processes in a Ray cluster (config ``collector=ray``, extra ``pickplace[ray]``).

    Args: as in :func:`multi_sync`, and ``address``: ``local`` starts a new Ray on this machine, ``auto`` or
        ``host:port`` joins a cluster.

    Raises:
        ValueError: without the extra, with a policy on a GPU, or if the workers do not divide the slots.
    """
    with require_extra("collector", "ray"):
        import ray  # noqa: F401
    expect(
        not any(parameter.is_cuda for parameter in policy.parameters()),
        "collector",
        "ray",
        "collector=single, or device=cpu, since its workers have no GPU",
    )
    collector = ResumableRayCollector(
        _shares(make_env, num_envs, workers, 1_024),
        policy,
        frames_per_batch=num_envs * rollout_length,
        total_frames=sys.maxsize,  # -1 would end it before its first batch
        sync=True,
        collector_class=ResumableCollector,
        collector_kwargs=[
            {"track_traj_ids": False, "auto_register_policy_transforms": False, "next_keys": next_keys}
            for _ in range(workers)
        ],
        trust_policy=True,
        weight_sync_schemes={},
        remote_configs={"num_cpus": 1, "num_gpus": 0},
        ray_init_config={
            "address": address, "include_dashboard": False, "logging_level": "warning", "log_to_driver": False,
            # A new Ray gets a core per worker, however few this machine has; a cluster states its own number.
            **({"num_cpus": workers} if address == "local" else {}),
        },
    )  # fmt: skip
    collector._weight_sync_initialized = True  # silences a warning about the missing scheme
    return _started(collector, _seeds(seed, workers))


def _started(collector, seeds: Sequence[tuple[int, ...]]):
    """Begin each worker's streams and return the collector; on an error shut it down, or the process would not end."""
    try:
        collector.map_fn("start", seeds)
    except BaseException:
        collector.shutdown()
        raise
    return collector


def _shares(make_env, num_envs: int, workers: int, most: int) -> list[partial]:
    whole_number("collector.workers", workers, most=most)
    expect(num_envs % workers == 0, "collector.workers", workers, f"a divisor of env.num_envs={num_envs}")
    share = num_envs // workers
    return [partial(make_env, worker * share, share) for worker in range(workers)]


def _seeds(seed: int, workers: int) -> list[tuple[int, int]]:
    """Seeds of each worker: of the item stream, the same for all, and of its own generator, which draws its actions.

    The large odd step keeps the generators apart from those of ``seed + 1``.
    """
    return [(seed, (seed * 1_000_003 + worker + 1) % 2**63) for worker in range(workers)]
