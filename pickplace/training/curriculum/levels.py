"""The curriculum of a run: its level, its counts, and what a checkpoint stores of them."""

import math
from collections import deque
from numbers import Real

from torch import Tensor

from pickplace.common.validate import expect, integral_number, is_number, is_whole, number
from pickplace.training.curriculum.advance import Advance, Tally


class Curriculum:
    """The level of a run, moved by an advance rule after each batch.

    Args:
        advance: an :class:`Advance` rule.
        sample: a height sampler, see :mod:`pickplace.training.curriculum.sample`.
        start_height: the first level and the least height drawn, in cells; None is the greatest item height.
        end_height: the last level, in cells; None is the tote's full height, ``tote_size[2]``.
    """

    def __init__(self, advance: Advance, sample, start_height: int | None = None, end_height: int | None = None):
        expect(
            isinstance(advance, Advance),
            "curriculum.advance",
            advance,
            "a rule, such as curriculum/advance=threshold",
        )
        expect(callable(sample), "curriculum.sample", sample, "a sampler, such as curriculum/sample=recent")
        self.advance, self.sample, self._rule = advance, sample, f"curriculum.advance: {type(advance).__name__}"
        self.start_height, self.end_height = start_height, end_height

    def setup(self, min_height: int, max_height: int, total_frames: int) -> None:
        """Set the heights and the budget of a run, and begin at the first level.

        Args:
            min_height: the greatest item height, in cells.
            max_height: the tote's full height, in cells.
            total_frames: the run's budget, in frames.

        Raises:
            ValueError: naming the setting that does not fit these numbers.
        """
        start = min_height if self.start_height is None else self.start_height
        end = max_height if self.end_height is None else self.end_height
        self.end = integral_number("curriculum.end_height", end, min_height, max_height)
        self.start = integral_number("curriculum.start_height", start, min_height, self.end)
        self.full_height = max_height
        first = self.advance.setup(self.start, self.end, integral_number("total_frames", total_frames))
        self.tally = Tally(self._clamped(first), deque(maxlen=self.advance.window))
        self._rule_state()  # raises here, not at the first checkpoint

    @property
    def level(self) -> int:
        """The tote height trained at now, in cells."""
        return self.tally.level

    def check_budget(self, total_frames: int, batch: int = 1) -> str | None:
        """Return a warning if full height cannot be trained within ``total_frames``, else None.

        Args:
            total_frames: the run's budget.
            batch: frames of a batch; the level moves only after a batch.
        """
        if self.end < self.full_height:
            return (
                f"curriculum.end_height={self.end}: nothing is trained at the full height, {self.full_height}, "
                "at which validation and evaluation play."
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
            frames: frames of the whole run, this batch included.

        Returns:
            Metrics to log: ``curriculum/level`` (from now on), ``/progress`` (0 at the first height, 1 at the last),
            ``/frames_at_level``, ``/episodes`` and ``/occupancy`` (number and windowed mean at the level; no mean
            without an episode), ``/occupancy_at_<height>`` (means of this batch), and the rule's own. Counts are
            those that the rule decided on; a change of level clears them afterwards.
        """
        tally, heights, occupancy = self.tally, heights.reshape(-1), occupancy.reshape(-1).double()
        at_level = occupancy[heights == tally.level].tolist()
        tally.frames, tally.episodes = frames, tally.episodes + len(at_level)
        tally.window.extend(at_level)
        answer = self.advance.update(tally)
        expect(
            isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], dict),
            f"{self._rule}: its update",
            answer,
            "(level, {name: number})",
        )
        level, logs = self._clamped(answer[0]), {**answer[1]}
        for name, value in logs.items():
            expect(isinstance(value, Real), f"{self._rule}: it logs {name}", value, "a number")
        self._rule_state()
        means = {height: occupancy[heights == height].mean().item() for height in heights.unique().tolist()}
        logs |= {
            "level": level,
            "frames_at_level": tally.level_frames,
            "episodes": tally.episodes,
            "progress": (level - self.start) / (self.end - self.start) if self.end > self.start else 1.0,
            **({"occupancy": tally.mean} if tally.window else {}),
            **{f"occupancy_at_{height}": mean for height, mean in means.items()},
        }
        if level != tally.level:
            self.tally = Tally(level, deque(maxlen=self.advance.window), frames, level_start=frames)
        return {f"curriculum/{key}": value for key, value in logs.items()}

    def _clamped(self, level) -> int:
        expect(is_whole(level), f"{self._rule}: its level", level, "a whole number")
        return min(max(int(level), self.start), self.end)

    def _rule_state(self) -> dict:
        """Return the rule's own state; raise if a checkpoint could not store it."""
        state = {key: getattr(self.advance, key, None) for key in self.advance.state_keys}
        for key, value in state.items():
            expect(
                isinstance(value, int | float) and is_number(value),  # exact in JSON
                f"{self._rule}: its state has {key}",
                value,
                "a finite Python number",
            )
        return state

    def state_dict(self) -> dict:
        """Return level, counts and the rule's own state as plain JSON types; JSON stores floats exactly."""
        return vars(self.tally) | {"window": list(self.tally.window), "advance": self._rule_state()}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a :meth:`state_dict`; call it after :meth:`setup`.

        Raises:
            ValueError: for the state of another advance rule, a level outside the heights, or no such state.
        """
        expect(
            isinstance(state, dict)
            and set(state) == {*vars(self.tally), "advance"}
            and isinstance(state["advance"], dict),
            "the checkpoint's curriculum",
            state,
            "the state that a training saved",
        )
        rule, name = state["advance"], type(self.advance).__name__
        expect(set(rule) == {*self.advance.state_keys}, "curriculum.advance", name, f"the run's, with {sorted(rule)}")
        key = "curriculum {} of the checkpoint".format
        level = integral_number(key("level"), state["level"], self.start, self.end)
        frames = integral_number(key("frames"), state["frames"], 0)
        counts = {name: integral_number(key(name), state[name], 0, frames) for name in ("level_start", "episodes")}
        expect(isinstance(state["window"], list), key("window"), state["window"], "a list of numbers between 0 and 1")
        window = deque((number(key("window"), value, most=1) for value in state["window"]), self.advance.window)
        for name, value in rule.items():
            expect(is_number(value), key(name), value, "a number")
        self.tally = Tally(level, window, frames, **counts)
        vars(self.advance).update(rule)
