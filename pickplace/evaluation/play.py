"""Episodes played to their end by a planner, and the time of its decisions."""

import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torchrl.envs.utils import step_mdp

from pickplace.common.machine import trim_memory
from pickplace.common.validate import check_bytes, one_of, refuse_if, whole_number
from pickplace.envs.checks import problem_bytes
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.items.distributions import check_seed
from pickplace.physics.engine import Engine
from pickplace.physics.plans import EpisodePlan
from pickplace.planners.base import BatchPlanner
from pickplace.planners.use import decide
from pickplace.rules.bin import select_item, taken_item
from pickplace.rules.grasps import split_action
from pickplace.rules.masks import num_feasible, placing_maps
from pickplace.rules.state import Failure
from pickplace.views.motion import Outcome
from pickplace.views.recording import Recording, items_in_bin, record_moves

log = logging.getLogger(__name__)

#: ``make_env(first_episode, num_envs)`` makes the environment for a share of the episodes.
MakeEnv = Callable[[int, int], PickPlaceEnv]

#: Greatest number of episodes, or of decisions that are timed.
MAX_EPISODES = 1_000_000

#: The tensors of :class:`Episodes`.
RESULTS = ("occupancy", "items_placed", "failure", "final_heights", "tote_height", "true_occupancy", "num_items")


@dataclass
class Episodes:
    """Results of a planner, one entry an episode."""

    occupancy: Tensor  # float64 [E]
    true_occupancy: Tensor  # float64 [E], of the true volumes, if sizes are rounded up to cells
    items_placed: Tensor  # int64 [E]
    num_items: Tensor  # int64 [E], items that arrive in the episode; 0: without end
    failure: Tensor  # int64 [E], a Failure; NONE where the item stream ended
    final_heights: Tensor  # int32 [E, W_T, D_T]: the tote when the episode ended
    tote_height: Tensor  # int64 [E]
    feasible_share: float  # mean share of the N_a actions that were feasible, over all decisions
    decisions: int  # over all episodes
    recordings: list[Recording] = field(default_factory=list)  # of the episodes that were to be recorded


class _Batch:
    """Episodes played side by side, one in each slot of an environment; a slot's first episode counts.

    Args:
        env: the environment.
        first: number of the first slot's episode.
        record, heat_maps: as in :func:`play`.
    """

    def __init__(self, env: PickPlaceEnv, first: int, record: Collection[int], heat_maps: Collection[int]):
        self.env, self.heat_maps = env, heat_maps
        self.running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        self.observation = env.reset()
        # Entries of Episodes for the slots that have ended.
        self.results = {
            "tote_height": env.tote_height.clone(),
            "num_items": env.items.num_items(env.stream, env.item_seed.expand_as(env.episode), env.episode),
        }
        self.true_volume = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
        self.recordings = {
            slot: Recording(first + slot, height)
            for slot, height in enumerate(env.tote_height.tolist())
            if first + slot in record
        }

    def feasible_shares(self) -> float:
        """Return the share of the ``N_a`` actions that are feasible, summed over the running episodes."""
        cell = self.env.cell
        share = num_feasible(cell, placing_maps(cell, self.env.state)).double() / cell.num_actions
        return float(share[self.running].sum())

    def record(self, planner: BatchPlanner, action: Tensor) -> None:
        """Add the moves that the actions are about to make to the recordings of running episodes."""
        running = {slot: recording for slot, recording in self.recordings.items() if self.running[slot]}
        for decided in (planner, None):  # with and without heat maps
            slots = [slot for slot in running if (running[slot].episode in self.heat_maps) == (decided is not None)]
            if slots:
                state = self.env.state.rows(slots)
                moves = record_moves(self.env.cell, decided, self.observation[slots], state, action[slots])
                for slot, move in zip(slots, moves, strict=True):
                    running[slot].moves.append(move)

    def _true_volumes(self, action: Tensor) -> Tensor:
        """Return the true volume of the item that each action takes, float64 ``[N]``."""
        env, items, volumes = self.env, self.env.state.items, self.env.items.volumes
        item = select_item(items, taken_item(env.cell, items, *split_action(env.cell, action)[:2]))
        return item.volume.double() if volumes is None else volumes.to(env.device)[item.kind]

    def step(self, action: Tensor) -> None:
        """Step the environment, and keep the results of the episodes that end.

        A slot whose episode has ended plays on, uncounted, until all have ended.
        """
        env, placed, volume = self.env, self.env.steps.clone(), self._true_volumes(action)
        after = env.step(self.observation.set("action", action))["next"]
        self.true_volume += (env.steps - placed) * volume
        done, failure = after["done"][:, 0], after["failure"][:, 0]
        ended = self.running & done
        now = {
            "occupancy": env.exact_occupancy,
            "true_occupancy": self.true_volume / env.cell.tote_volume(env.tote_height),
            "items_placed": env.steps,
            "failure": failure,
            "final_heights": env.state.heights,
        }
        for name, values in now.items():
            where = ended.view(-1, *[1] * (values.ndim - 1))
            self.results[name] = torch.where(where, values, self.results.get(name, values))
        for slot, recording in self.recordings.items():
            if ended[slot]:
                recording.ending, recording.occupancy = Failure(int(failure[slot])), float(now["occupancy"][slot])
                if recording.ending == Failure.STUCK:
                    recording.waiting = items_in_bin(env.state.items, slot)
        self.running = self.running & ~done
        self.observation = step_mdp(self.observation)
        if done.any() and self.running.any():
            self.observation = env.reset(self.observation.set("_reset", after["done"]))


def check_episode_settings(evaluation: Mapping) -> None:
    """Check the values of the config group ``evaluation`` that determine what is played.

    Raises:
        ValueError: naming the key, its value, and what was expected.
    """
    for key, least in {"episodes": 1, "batch_size": 1, "latency_decisions": 0}.items():
        whole_number(f"evaluation.{key}", evaluation.get(key), least, MAX_EPISODES)
    one_of("evaluation.stream", evaluation.get("stream"), ("validation", "test"))
    check_seed(evaluation.get("seed"), "evaluation.seed")


def check_play(evaluation: Mapping, env: PickPlaceEnv) -> None:
    """Refuse more episodes than the items have, or more side by side than the memory holds.

    Args:
        evaluation: the config group.
        env: an environment like those that are played.

    Raises:
        ValueError: naming the key.
    """
    episodes, most = evaluation["episodes"], env.items.num_episodes(evaluation["stream"])
    stream = f"evaluation.stream={evaluation['stream']}"
    refuse_if(most == 0, f"{stream}: the items have no episodes for it; expected another stream, or items.split=true.")
    refuse_if(
        most is not None and episodes > most,
        f"evaluation.episodes={episodes}: the items of {stream} have {most} different episodes; expected {most} at "
        "most, as others would repeat them.",
    )
    together = min(evaluation["batch_size"], episodes)
    check_bytes(f"evaluation.batch_size={together}", together * problem_bytes(env.cell, ()), env.device)


@torch.no_grad()
def play(
    make_env: MakeEnv,
    planner: BatchPlanner,
    episodes: int,
    batch_size: int,
    record: Collection[int] = (),
    heat_maps: Collection[int] | None = None,
) -> Episodes:
    """Play episodes ``0 .. episodes - 1``, each in a slot of its own, to their ends, and count them all.

    Collecting "the first n episodes to finish" would favour short ones, and short ones are the bad ones.

    Args:
        make_env: makes the environment, see :data:`MakeEnv`.
        planner: decides, see :class:`~pickplace.planners.base.BatchPlanner`.
        batch_size: episodes played side by side. It changes no result, except with a planner that draws random
            numbers: it has one generator for all episodes of a batch.
        record: numbers of the episodes to record move by move.
        heat_maps: numbers of recorded episodes that get the planner's heat maps, which take time; None: all.
    """
    heat_maps = record if heat_maps is None else heat_maps
    feasible, decisions = 0.0, 0
    parts: list[dict[str, Tensor]] = []
    recordings: list[Recording] = []
    for first in range(0, episodes, batch_size):
        batch = _Batch(make_env(first, min(batch_size, episodes - first)), first, record, heat_maps)
        while batch.running.any():
            feasible += batch.feasible_shares()
            decisions += int(batch.running.sum())
            action = decide(planner, batch.env.cell, batch.observation)
            batch.record(planner, action)
            batch.step(action)
            trim_memory()
        parts.append(batch.results)
        recordings += batch.recordings.values()
    return Episodes(
        **{name: torch.cat([part[name] for part in parts]).cpu() for name in RESULTS},
        feasible_share=feasible / decisions,
        decisions=decisions,
        recordings=recordings,
    )


@contextmanager
def evaluation_mode(*modules: nn.Module) -> Iterator[None]:
    """Within this context, dropout and batch statistics are not used, as in ``pickplace-evaluate``.

    A module with a true attribute ``validates_as_trained`` stays in training mode.
    """
    parts = {part: part.training for module in modules for part in module.modules()}
    for part in parts:
        part.training = getattr(part, "validates_as_trained", False)
    try:
        yield
    finally:
        for part, training in parts.items():
            part.training = training


@torch.no_grad()
def decision_latency(make_env: MakeEnv, planner: BatchPlanner, decisions: int) -> dict[str, float] | None:
    """Return the milliseconds of a decision for one tote in states of episodes, ``{"p50", "p95"}``; None for 0."""
    if decisions < 1:
        return None
    env = make_env(0, 1)
    observation, times = env.reset(), []
    decide(planner, env.cell, observation)  # warm up
    for _ in range(decisions):
        start = time.perf_counter()
        action = decide(planner, env.cell, observation)
        if action.device.type == "cuda":  # where a call returns before its work is done
            torch.cuda.synchronize(action.device)
        times.append((time.perf_counter() - start) * 1e3)
        _, observation = env.step_and_maybe_reset(observation.set("action", action))
    milliseconds = torch.tensor(times, dtype=torch.float64)
    return {"p50": float(milliseconds.quantile(0.5)), "p95": float(milliseconds.quantile(0.95))}


def carry_out(engine: Engine, plans: Sequence[EpisodePlan], recordings: Sequence[Recording]) -> list[Outcome]:
    """Return the outcomes of plans that a physics engine carries out, and add them to the recordings of their episodes.

    Raises:
        ValueError: if the engine yields anything but an outcome for each plan.
    """
    outcomes: list[Outcome] = []
    shown = {recording.episode: recording for recording in recordings}
    for outcome in engine.carry_out(plans, record=shown):
        outcomes.append(outcome)
        if outcome.episode in shown:
            shown[outcome.episode].carried_out = outcome
        if len(outcomes) % 10 == 0 or len(outcomes) == len(plans):
            log.info("physics=%s: %s of %s episodes", engine.name, f"{len(outcomes):,}", f"{len(plans):,}")
    refuse_if(
        (found := [outcome.episode for outcome in outcomes]) != (wanted := [plan.episode for plan in plans]),
        f"physics={engine.name}: outcomes of the episodes {found}, expected {wanted}.",
    )
    return outcomes
