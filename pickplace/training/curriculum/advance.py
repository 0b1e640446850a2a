"""Advance rules, which decide when the level changes."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pickplace.common.validate import expect, integral_number, number, or_null

STAGE_KEYS = {"frames", "level"}, {"frames", "height"}
TOLERANCE = 1e-6  # occupancies arrive as float32, in which 0.9 is slightly below 0.9


@dataclass
class Tally:
    """Input of an advance rule: the level, and counts since it began.

    Attributes:
        level: number of the current level.
        window: final occupancies of the latest episodes that were played at the level.
        frames: frames of the whole run.
        level_start: the run's frames when the level began.
        episodes: episodes finished at the level.
        latest: level and final occupancy of each episode that the latest batch finished, at any level.
    """

    level: int
    window: deque
    frames: int = 0
    level_start: int = 0
    episodes: int = 0
    latest: Sequence[tuple[int, float]] = ()

    @property
    def level_frames(self) -> int:
        """Frames since the level began."""
        return self.frames - self.level_start

    @property
    def mean(self) -> float:
        """Mean occupancy of the window; fsum rounds once, so the order of the episodes has no effect."""
        return math.fsum(self.window) / len(self.window) if self.window else 0.0


class Advance:
    """Base class of advance rules. A subclass overrides :meth:`update`, and other methods where needed.

    Attributes:
        window: number of latest episodes at the level that the tally keeps.
        state_keys: names of the attributes that are the rule's own state, saved in checkpoints; after :meth:`setup`
            each is a value that JSON holds, with finite numbers.
        heights_key: the setting that names levels by the tote's height, which a list of levels refuses; empty: none.
        start, end: the first and the last level, set by :meth:`setup`.
    """

    window = 100
    state_keys: tuple[str, ...] = ()
    heights_key = ""

    def setup(self, start: int, end: int, total_frames: int) -> int:
        """Store the first and the last level and use the run's budget in frames; return the level to begin with."""
        self.start, self.end = start, end
        return start

    def update(self, tally: Tally) -> tuple[int, dict]:
        """Return the level from now on, and further numbers to log, by name; called after each batch.

        A level before the first or after the last one is clipped.
        """
        raise NotImplementedError

    def weights(self) -> list[float]:
        """Return the weight of each level for the draw of new episodes, first to last; empty: the sampler draws."""
        return []

    def load_state(self, state: dict) -> None:
        """Continue from saved values of the :attr:`state_keys`; ``ValueError`` for impossible values."""
        vars(self).update(state)

    def least_frames(self, batch: int) -> float:
        """Lower bound of the frames before the last level is reached; infinite if it never is.

        Args:
            batch: frames between two decisions.
        """
        return 0


class NoAdvance(Advance):
    """No curriculum: the last level from the first frame on."""

    def setup(self, start, end, total_frames):
        return super().setup(end, end, total_frames)

    def update(self, tally):
        return tally.level, {}


class Frames(Advance):
    """One level up every ``frames_per_level`` frames of the run: the paper's rule, with 5 million.

    Args:
        frames_per_level: frames; None divides ``total_frames`` evenly among the levels.
    """

    def __init__(self, frames_per_level: int | None = None):
        self.frames_per_level = or_null(integral_number, "curriculum.advance.frames_per_level", frames_per_level)

    def setup(self, start, end, total_frames):
        self.share = self.frames_per_level or max(1, total_frames // (end - start + 1))
        return super().setup(start, end, total_frames)

    def update(self, tally):
        # Never down: a run resumed with a larger budget may have more frames per level.
        return tally.level + (self.start + tally.frames // self.share > tally.level), {}

    def least_frames(self, batch):
        return (self.end - self.start) * max(self.share, batch)


class Threshold(Advance):
    """One level up when the mean occupancy of a window of episodes at the level reaches a value.

    Args:
        occupancy: the mean occupancy that promotes, in [0, 1].
        window: number of latest episodes that count; with fewer at this level, occupancy has no effect.
        max_frames_per_level: promote after this many frames at a level, whatever the occupancy; None: never.
        demote_below: go one level down when the mean is below this occupancy; None: never.
    """

    def __init__(
        self,
        occupancy: float,
        window: int,
        max_frames_per_level: int | None = None,
        demote_below: float | None = None,
    ):
        self.occupancy = number("curriculum.advance.occupancy", occupancy, most=1)
        self.window = integral_number("curriculum.advance.window", window)
        self.max_frames = (
            or_null(integral_number, "curriculum.advance.max_frames_per_level", max_frames_per_level) or math.inf
        )
        self.demote_below = or_null(number, "curriculum.advance.demote_below", demote_below, 0, 1) or 0.0
        expect(
            demote_below is None or demote_below < occupancy,
            "curriculum.advance.demote_below",
            demote_below,
            f"< {occupancy=}",
        )

    def update(self, tally):
        full = len(tally.window) == self.window
        up = full and tally.mean >= self.occupancy - TOLERANCE
        up |= tally.level_frames >= self.max_frames and tally.level < self.end  # from the last it may still go down
        down = full and tally.mean < self.demote_below - TOLERANCE and not up
        return tally.level + up - down, {}

    def least_frames(self, batch):  # an episode takes at least one frame
        return (self.end - self.start) * max(min(self.window, self.max_frames), batch)


class Plateau(Advance):
    """One level up when the mean occupancy at the level stops improving.

    Args:
        window: episodes in a window; windows do not overlap; each is compared with the level's best so far.
        patience: promote after this many windows in a row without an improvement.
        min_improvement: least increase in mean occupancy that is an improvement, in [0, 1].
    """

    state_keys = ("best", "stale", "compared")

    def __init__(self, window: int, patience: int, min_improvement: float = 0.01):
        self.window = integral_number("curriculum.advance.window", window)
        self.patience = integral_number("curriculum.advance.patience", patience)
        self.min_improvement = number("curriculum.advance.min_improvement", min_improvement, most=1)

    def setup(self, start, end, total_frames):
        self._clear()
        return super().setup(start, end, total_frames)

    def _clear(self):
        # The best window's mean, the number of windows since, and the tally's episodes at the latest comparison.
        self.best, self.stale, self.compared = 0.0, 0, 0

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
        self._clear()
        return tally.level + 1, logs

    def least_frames(self, batch):  # an episode takes at least one frame
        return (self.end - self.start) * self.patience * max(self.window, batch)


class Staged(Advance):
    """The level from a list of stages.

    Args:
        stages: ``{frames, level}`` each: from that frame of the run on, that level; None is the last one. ``frames``
            ascend. Before the first stage it is the first level. If levels are heights, the key may be ``height``.
    """

    def __init__(self, stages):
        expect(
            isinstance(stages, Sequence)
            and stages
            and all(isinstance(stage, Mapping) and set(stage) in STAGE_KEYS for stage in stages),
            "curriculum.advance.stages",
            stages,
            "a list of {frames: F, level: L}; what a level sets stands in curriculum.levels",
        )
        if any("height" in stage for stage in stages):
            self.heights_key = "curriculum.advance.stages: height"
        self.stages: dict[int, int | None] = {}  # levels by first frame
        for stage in stages:
            least = max(self.stages, default=-1) + 1
            frames = integral_number("curriculum.advance.stages: frames", stage["frames"], least)
            self.stages[frames] = stage.get("level", stage.get("height"))

    def setup(self, start, end, total_frames):
        super().setup(start, end, total_frames)
        key = "curriculum.advance.stages: level"
        self.plan = {f: end if h is None else integral_number(key, h, start, end) for f, h in self.stages.items()}
        return self._level_at(0)

    def _level_at(self, frames: int) -> int:
        return ([self.start] + [level for first, level in self.plan.items() if first <= frames])[-1]

    def update(self, tally):
        return self._level_at(tally.frames), {}

    def least_frames(self, batch):
        first = min((f for f in (0, *self.plan) if self._level_at(f) == self.end), default=math.inf)
        return first if first == math.inf else -(-first // batch) * batch
