"""Curricula: how high the tote is in each training episode.

A curriculum is levels x advance rule x height sampler; a level is a tote height. :class:`Curriculum` lives in
the main process, which alone owns the level, and asks its advance rule after each batch. The transform
:class:`ToteHeightCurriculum` draws the heights in every collector process, and :func:`push_level` carries the
level there.
"""

import math
import reprlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

TOLERANCE = 1e-6  # occupancies arrive as float32, in which 0.9 lies below 0.9


def _whole(key: str, value, least: int = 1, greatest: float = math.inf) -> int:
    """``value`` as an int in ``[least, greatest]``; a float such as 5e6 is one too."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or value % 1 != 0 or not least <= value <= greatest:
        limit = f" and <= {greatest}" if greatest < math.inf else ""
        raise ValueError(f"{key}={value!r}: expected a whole number >= {least}{limit}.")
    return int(value)


def _fraction(key: str, value) -> float:
    """``value`` as a float in ``[0, 1]``."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value <= 1:
        raise ValueError(f"{key}={value!r}: expected a number between 0 and 1.")
    return float(value)


def _plain_number(value) -> bool:
    """Is it a finite number that JSON keeps?"""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < math.inf


class Current:
    """Height sampler: every episode at the level's own height."""

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        """Heights for ``count`` episodes, int64 ``[count]``."""
        return torch.full((count,), level, dtype=torch.int64)


class Uniform:
    """Height sampler: uniform from the least height up to the level, by torch's global generator."""

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        """Heights for ``count`` episodes, int64 ``[count]``."""
        return torch.randint(min_height, level + 1, (count,))


class Recent:
    """Height sampler: the level, but for a share of episodes at earlier heights, against forgetting.

    Args:
        share: probability in [0, 1] of an earlier height, drawn uniformly by torch's global generator.
    """

    def __init__(self, share: float = 0.25):
        self.share = _fraction("curriculum.sample.share", share)

    def __call__(self, level: int, min_height: int, count: int) -> Tensor:
        """Heights for ``count`` episodes, int64 ``[count]``."""
        earlier = torch.randint(min_height, max(level, min_height + 1), (count,))
        return torch.where(torch.rand(count) < self.share, earlier, level)


class ToteHeightCurriculum(Transform):
    """Writes ``tote_height``, int64 ``[N, 1]``, into full and partial resets; running episodes keep theirs.

    Make it the first transform of the environment's ``Compose``, where :func:`push_level` looks for it.

    Args:
        level: the level to begin with.
        sampler: draws heights, given ``(level, min_height, count)``; see :class:`Current`.
        min_height: the least height the sampler may draw.
    """

    def __init__(self, level: int, sampler, min_height: int):
        super().__init__()
        self.sampler, self.min_height = sampler, _whole("min_height", min_height)
        # A buffer, so that it is in state_dict() and follows the environment to its device.
        self.register_buffer("level", torch.tensor(0, dtype=torch.int64))
        self.set_level(level)

    def set_level(self, level: int) -> None:
        """Draw the heights of coming episodes at this level."""
        self.level.fill_(_whole("level", level, self.min_height))

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:  # a plain env.reset()
            tensordict = TensorDict(batch_size=self.parent.batch_size, device=self.parent.device)
        count = tensordict.numel()
        height = self.sampler(int(self.level), self.min_height, count)
        if not isinstance(height, Tensor) or height.numel() != count or height.is_floating_point():
            raise ValueError(
                f"curriculum.sample: {type(self.sampler).__name__} gave {reprlib.repr(height)}; expected heights, "
                f"whole numbers in a tensor [{count}]."
            )
        height = height.to(self.level.device).reshape(*tensordict.batch_size, 1)
        reset, running = tensordict.get("_reset", None), tensordict.get("tote_height", None)
        # Collectors hide `tote_height` from a reset: then running rows hold a draw too, but nobody reads it.
        if reset is not None and running is not None:
            height = torch.where(reset.reshape(height.shape), height, running)
        return tensordict.set("tote_height", height)


def push_level(collector, level: int) -> None:
    """Set the level in every process of any of our collectors, between two batches.

    ``map_fn(path, list_of_args)`` calls a method by its path: on a direct collector once for each entry of
    the list, on a multi-process one once in each worker, where the list must have ``num_workers`` entries.
    Results travel back through a pipe, so the path ends at a method that returns nothing.
    """
    workers = getattr(collector, "num_workers", 1)
    collector.map_fn("env.transform[0].set_level", [(level,)] * workers)


@dataclass
class Tally:
    """What an advance rule sees: the level, and what has happened since it began."""

    level: int
    window: deque  # occupancies of the latest episodes at the level's own height
    frames: int = 0  # of the whole run
    began: int = 0  # the run's frames when the level began
    episodes: int = 0  # finished at the level's own height

    @property
    def level_frames(self) -> int:
        """Frames since the level began."""
        return self.frames - self.began

    @property
    def mean(self) -> float:
        """Mean occupancy of the window; fsum rounds once, so the order of the episodes cannot matter."""
        return math.fsum(self.window) / len(self.window) if self.window else 0.0


class Advance:
    """An advance rule: subclasses override :meth:`update`, and what else they need to.

    Attributes:
        window: how many of the latest episodes at the level's own height the tally keeps.
        remembers: names of the attributes that are state of the rule's own, each a plain number, from :meth:`setup` on.
        start, end: the first and the last height, known after :meth:`setup`.
    """

    window = 100
    remembers: tuple[str, ...] = ()

    def setup(self, start: int, end: int, total_frames: int) -> int:
        """Learn the first and the last height and the run's budget in frames; returns the first level."""
        self.start, self.end = start, end
        return start

    def update(self, tally: Tally) -> tuple[int, dict]:
        """The level from now on, a whole number, and what else to log, numbers by name; called after each batch.

        A level beyond the first or the last height is taken for that height.
        """
        raise NotImplementedError

    def least_frames(self, batch: int) -> float:
        """Frames before which the last height surely is not reached; infinite if it never is.

        Args:
            batch: frames between two decisions.
        """
        return 0


class NoAdvance(Advance):
    """No curriculum: the last height from the first frame on."""

    def setup(self, start, end, total_frames):
        super().setup(start, end, total_frames)
        return end

    def update(self, tally):
        return tally.level, {}


class Frames(Advance):
    """One level up each ``frames_per_level`` frames of the run: the paper's rule, with 5 million.

    Args:
        frames_per_level: frames; None divides ``total_frames`` evenly among the levels.
    """

    def __init__(self, frames_per_level: int | None = None):
        if frames_per_level is not None:
            frames_per_level = _whole("curriculum.advance.frames_per_level", frames_per_level)
        self.frames_per_level = frames_per_level

    def setup(self, start, end, total_frames):
        self.share = self.frames_per_level or max(1, total_frames // (end - start + 1))
        return super().setup(start, end, total_frames)

    def update(self, tally):
        # Never down: a run resumed with a longer budget may have more frames to divide.
        due = self.start + tally.frames // self.share > tally.level
        return tally.level + due, {}

    def least_frames(self, batch):
        return (self.end - self.start) * max(self.share, batch)


class Threshold(Advance):
    """One level up when the mean occupancy of a window of episodes at the level's own height reaches a value.

    Args:
        occupancy: the mean occupancy that promotes, in [0, 1].
        window: how many of the latest episodes count; with fewer at this level, occupancy decides nothing.
        max_frames_per_level: promote after so many frames at a level whatever the occupancy; None never does.
        demote_below: one level down when the mean is below this occupancy; None never does.
    """

    def __init__(
        self,
        occupancy: float,
        window: int,
        max_frames_per_level: int | None = None,
        demote_below: float | None = None,
    ):
        self.occupancy = _fraction("curriculum.advance.occupancy", occupancy)
        self.window = _whole("curriculum.advance.window", window)
        self.max_frames = math.inf
        if max_frames_per_level is not None:
            self.max_frames = _whole("curriculum.advance.max_frames_per_level", max_frames_per_level)
        self.demote_below = 0.0
        if demote_below is not None:
            self.demote_below = _fraction("curriculum.advance.demote_below", demote_below)
            if self.demote_below >= self.occupancy:
                raise ValueError(f"curriculum.advance.demote_below={demote_below}: expected < {occupancy=}.")

    def update(self, tally):
        full = len(tally.window) == self.window
        reached = full and tally.mean >= self.occupancy - TOLERANCE
        if reached or tally.level_frames >= self.max_frames:
            return tally.level + 1, {}
        if full and tally.mean < self.demote_below - TOLERANCE:
            return tally.level - 1, {}
        return tally.level, {}

    def least_frames(self, batch):  # an episode takes at least one frame
        return (self.end - self.start) * max(min(self.window, self.max_frames), batch)


class Plateau(Advance):
    """One level up when the mean occupancy at the level's own height stops improving.

    Args:
        window: episodes in a window; windows do not overlap; each is compared with the level's best so far.
        patience: promote after so many windows in a row without an improvement.
        min_improvement: what counts as one, in mean occupancy, [0, 1].
    """

    remembers = ("best", "stale", "compared")

    def __init__(self, window: int, patience: int, min_improvement: float = 0.01):
        self.window = _whole("curriculum.advance.window", window)
        self.patience = _whole("curriculum.advance.patience", patience)
        self.min_improvement = _fraction("curriculum.advance.min_improvement", min_improvement)

    def setup(self, start, end, total_frames):
        self._forget()
        return super().setup(start, end, total_frames)

    def _forget(self):
        self.best, self.stale = 0.0, 0  # the best window's mean, and the windows since
        self.compared = 0  # episodes at the latest comparison

    def update(self, tally):
        if tally.episodes - self.compared >= self.window:
            self.compared, improvement = tally.episodes, tally.mean - self.best
            if improvement > 0 and improvement >= self.min_improvement - TOLERANCE:
                self.best, self.stale = tally.mean, 0
            else:
                self.stale += 1
        logs = {"best_occupancy": self.best, "stale_windows": self.stale}
        if self.stale < self.patience or tally.level == self.end:
            return tally.level, logs
        self._forget()
        return tally.level + 1, logs

    def least_frames(self, batch):  # an episode takes at least one frame
        return (self.end - self.start) * self.patience * max(self.window, batch)


class Staged(Advance):
    """The level from a list of stages, as plain data.

    Args:
        stages: ``{frames, height}`` each: from that frame of the run on the level is that height, where None
            is the last height. ``frames`` ascend. Before the first stage the level is the first height.
    """

    def __init__(self, stages):
        self.stages, least = [], 0
        if not isinstance(stages, Sequence) or isinstance(stages, str):
            raise ValueError(f"curriculum.advance.stages={stages!r}: expected a list of {{frames: F, height: H}}.")
        for stage in stages:
            if not isinstance(stage, Mapping) or set(stage) != {"frames", "height"}:
                raise ValueError(f"curriculum.advance.stages: got {stage!r}, expected {{frames: F, height: H}}.")
            frames = _whole("curriculum.advance.stages: frames", stage["frames"], least)
            self.stages.append((frames, stage["height"]))
            least = frames + 1
        if not self.stages:
            raise ValueError("curriculum.advance.stages=[]: expected at least one {frames: F, height: H}.")

    def setup(self, start, end, total_frames):
        super().setup(start, end, total_frames)
        key = "curriculum.advance.stages: height"
        self.plan = [(f, end if h is None else _whole(key, h, start, end)) for f, h in self.stages]
        return self._height_at(0)

    def _height_at(self, frames: int) -> int:
        return ([self.start] + [height for since, height in self.plan if since <= frames])[-1]

    def update(self, tally):
        return self._height_at(tally.frames), {}

    def least_frames(self, batch):
        return min((f for f in (0, *dict(self.plan)) if self._height_at(f) == self.end), default=math.inf)


class Curriculum:
    """Owns the level, and moves it by what the finished episodes show.

    Args:
        advance: an :class:`Advance` rule.
        sample: a height sampler, such as :class:`Current`.
        start_height: the first level and the least height drawn, in cells; None is the greatest item height.
        end_height: the last level, in cells; None is the tote's full height, ``tote_size[2]``.
    """

    def __init__(self, advance: Advance, sample, start_height: int | None = None, end_height: int | None = None):
        if not isinstance(advance, Advance):
            raise ValueError(f"curriculum.advance={advance!r}: expected a rule, such as curriculum/advance=threshold.")
        if not callable(sample):
            raise ValueError(f"curriculum.sample={sample!r}: expected a sampler, such as curriculum/sample=recent.")
        self.advance, self.sample = advance, sample
        self.start_height, self.end_height = start_height, end_height

    def setup(self, min_height: int, max_height: int, total_frames: int) -> None:
        """Bind the numbers of a run and begin at the first level.

        Args:
            min_height: the greatest item height, in cells.
            max_height: the tote's full height, in cells.
            total_frames: the run's budget, in frames.

        Raises:
            ValueError: naming the setting that does not fit these numbers.
        """
        end = max_height if self.end_height is None else self.end_height
        self.end = _whole("curriculum.end_height", end, min_height, max_height)
        self.full_height = max_height
        start = min_height if self.start_height is None else self.start_height
        self.start = _whole("curriculum.start_height", start, min_height, self.end)
        first = self.advance.setup(self.start, self.end, _whole("total_frames", total_frames))
        self.tally = Tally(self._within(first), deque(maxlen=self.advance.window))
        self._remembered()

    @property
    def level(self) -> int:
        """The tote height trained at now, in cells."""
        return self.tally.level

    def transform(self) -> ToteHeightCurriculum:
        """A transform for one collector process, at the present level."""
        return ToteHeightCurriculum(self.level, self.sample, self.start)

    def check_budget(self, total_frames: int, batch: int = 1) -> str | None:
        """A sentence if full height surely cannot be trained within ``total_frames``, else None.

        Args:
            total_frames: the run's budget.
            batch: frames of a batch, after each of which the level may move.
        """
        if self.end < self.full_height:
            return (
                f"curriculum.end_height={self.end}: nothing is trained at the full height, {self.full_height}, "
                "where validation and evaluation play."
            )
        least = self.advance.least_frames(batch)
        if least < total_frames:
            return None
        expected = f"more than {least} frames" if least < math.inf else "a stage of that height"
        return (
            f"total_frames={total_frames}: the curriculum ({type(self.advance).__name__}, from height "
            f"{self.start}) cannot train at its last height {self.end}; expected {expected}."
        )

    def update(self, heights: Tensor, occupancy: Tensor, frames: int) -> dict:
        """Count a batch's finished episodes and move the level.

        Args:
            heights: their tote heights, int ``[E]``; E may be 0.
            occupancy: their final occupancies, float ``[E]``.
            frames: frames of the whole run so far, this batch included.

        Returns:
            What to log: ``curriculum/level`` (from now on), ``/progress`` (0 at the first height, 1 at the
            last), ``/frames_at_level``, ``/episodes`` and ``/occupancy`` (number and windowed mean at the
            level's own height; the mean only if there is one), ``/occupancy_at_<height>`` (means of this
            batch), and the rule's own. Tallies are those the rule decided on; a level change clears them.
        """
        tally, heights, occupancy = self.tally, heights.reshape(-1), occupancy.reshape(-1).double()
        own = occupancy[heights == tally.level].tolist()
        tally.frames, tally.episodes = frames, tally.episodes + len(own)
        tally.window.extend(own)
        answer = self.advance.update(tally)
        if not isinstance(answer, tuple) or len(answer) != 2 or not isinstance(answer[1], dict):
            raise ValueError(f"{self._rule}: update gave {reprlib.repr(answer)}; expected (level, {{name: number}}).")
        level, logs = self._within(answer[0]), {**answer[1]}
        self._remembered()
        for name, value in logs.items():
            if not isinstance(value, Real):
                raise ValueError(f"{self._rule}: it logs {name}={reprlib.repr(value)}; expected a number.")
        logs |= {"level": level, "frames_at_level": tally.level_frames, "episodes": tally.episodes}
        logs["progress"] = (level - self.start) / (self.end - self.start) if self.end > self.start else 1.0
        if tally.window:
            logs["occupancy"] = tally.mean
        for height in heights.unique().tolist():
            logs[f"occupancy_at_{height}"] = occupancy[heights == height].mean().item()
        if level != tally.level:
            self.tally = Tally(level, deque(maxlen=self.advance.window), frames, began=frames)
        return {f"curriculum/{key}": value for key, value in logs.items()}

    @property
    def _rule(self) -> str:
        return f"curriculum.advance: {type(self.advance).__name__}"

    def _within(self, level) -> int:
        """A level of the rule's, between the first and the last height."""
        if isinstance(level, bool) or not isinstance(level, Integral):
            raise ValueError(f"{self._rule} wants level {reprlib.repr(level)}; expected a whole number.")
        return min(max(int(level), self.start), self.end)

    def _remembered(self) -> dict:
        """The rule's own state; what could not be saved, or be loaded again, is told now, not after hours."""
        state = {key: getattr(self.advance, key, None) for key in self.advance.remembers}
        for name, value in state.items():
            if not _plain_number(value):
                raise ValueError(
                    f"{self._rule} remembers {name}={reprlib.repr(value)}; expected a plain, finite number."
                )
        return state

    def state_dict(self) -> dict:
        """Level, tallies and the rule's own state, in plain JSON types; JSON keeps floats exactly."""
        return vars(self.tally) | {"window": list(self.tally.window), "advance": self._remembered()}

    def load_state_dict(self, state: dict) -> None:
        """Continue where :meth:`state_dict` was taken; call after :meth:`setup`.

        Raises:
            ValueError: the state of another advance rule, a level outside the configured heights, or no such state.
        """
        rule = state.get("advance") if isinstance(state, dict) else None
        if not isinstance(rule, dict) or set(state) != {*vars(self.tally), "advance"}:
            raise ValueError(f"The checkpoint's curriculum is {reprlib.repr(state)}; expected what a training wrote.")
        if set(rule) != set(self.advance.remembers):
            raise ValueError(
                f"curriculum.advance={type(self.advance).__name__}: the checkpoint has the state "
                f"{sorted(rule)}, expected {sorted(self.advance.remembers)}; resume with the run's own rule."
            )
        key = "curriculum {} of the checkpoint".format
        level = _whole(key("level"), state["level"], self.start, self.end)
        counts = {name: _whole(key(name), state[name], 0) for name in ("frames", "began", "episodes")}
        if not isinstance(state["window"], list):
            raise ValueError(
                f"{key('window')}={reprlib.repr(state['window'])}: expected a list of numbers between 0 and 1."
            )
        window = deque((_fraction(key("window"), share) for share in state["window"]), self.advance.window)
        for name, value in rule.items():
            if not _plain_number(value):
                raise ValueError(f"{key(name)}={value!r}: expected a number.")
        self.tally = Tally(level, window, **counts)
        vars(self.advance).update(rule)
