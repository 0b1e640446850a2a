"""The curriculum of a run: its level, its counts, and their state in a checkpoint."""

import logging
import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from copy import deepcopy
from numbers import Real

from torch import Tensor

from pickplace.common.validate import expect, integral_number, is_number, is_whole, number, refuse_if
from pickplace.items.distributions import ItemDistribution
from pickplace.rules.cell import CellSpec
from pickplace.training.curriculum.advance import Advance, NoAdvance, Tally
from pickplace.training.curriculum.levels import heights, read_levels
from pickplace.training.curriculum.sample import Current

log = logging.getLogger(__name__)
OWN_MEAN = re.compile(r"occupancy(_at_\d+)?")  # means that the curriculum logs


class Curriculum:
    """The level of a run, moved by an advance rule after each batch.

    Args:
        advance: an :class:`Advance` rule.
        sample: a sampler of levels, see :mod:`pickplace.training.curriculum.sample`.
        start_height, end_height: a short form of levels that differ only in the height of the tote: the first and the
            last height, in height units; None: the height of the tallest item, and the tote's full height.
        levels: settings of each level, see :func:`~pickplace.training.curriculum.levels.read_levels`; None: levels of
            these heights.
    """

    def __init__(
        self,
        advance: Advance,
        sample,
        start_height: int | None = None,
        end_height: int | None = None,
        levels: Sequence[Mapping] | None = None,
    ):
        expect(
            isinstance(advance, Advance),
            "curriculum.advance",
            advance,
            "a rule, such as curriculum/advance=threshold",
        )
        expect(callable(sample), "curriculum.sample", sample, "a sampler, such as curriculum/sample=recent")
        self.advance, self.sample, self._rule = advance, sample, f"curriculum.advance: {type(advance).__name__}"
        self.start_height, self.end_height, self.given = start_height, end_height, levels
        if levels is not None:
            for key, height in (("start_height", start_height), ("end_height", end_height)):
                expect(height is None, f"curriculum.{key}", height, "null where curriculum.levels lists the levels")
            refuse_if(
                advance.heights_key,
                f"{advance.heights_key}: expected level, a number, where curriculum.levels lists the levels.",
            )

    def setup(self, cell: CellSpec, items: ItemDistribution, total_frames: int) -> None:
        """Set the levels and the budget of a run, and begin at the first level.

        Args:
            cell, items: of the full task.
            total_frames: the run's budget, in frames.

        Raises:
            ValueError: naming the setting that does not fit these.
        """
        if self.given is None:
            min_height, max_height = items.tallest(), cell.tote_size[2]
            start = min_height if self.start_height is None else self.start_height
            end = max_height if self.end_height is None else self.end_height
            end = integral_number("curriculum.end_height", end, min_height, max_height)
            start = integral_number("curriculum.start_height", start, min_height, end)
            self.levels = heights(start, end, max_height)
        else:
            self.levels = read_levels(self.given, cell, items)
        self.start, self.end = self.levels.first, self.levels.last
        first = self.advance.setup(self.start, self.end, integral_number("total_frames", total_frames))
        self.tally = Tally(self._clamped(first), deque(maxlen=self.advance.window))
        self._numbers: set[str] = set()
        state, _ = self._rule_state(), self.weights  # raise here, not at the first checkpoint
        self._numbers = {key for key, value in state.items() if isinstance(value, Real)}

    @property
    def level(self) -> int:
        """Number of the current level; if levels are heights, the height of the tote in height units."""
        return self.tally.level

    @property
    def level_name(self) -> str:
        """Name of a level to show: ``tote height`` if levels are heights, else ``level``."""
        return self.levels.key.replace("_", " ")

    @property
    def weights(self) -> list[float]:
        """Weight of each level for the draw of new episodes, by the rule; empty: the sampler draws."""
        weights, count = self.advance.weights(), self.end - self.start + 1
        are_numbers = isinstance(weights, list) and all(is_number(weight) and weight >= 0 for weight in weights)
        good = are_numbers and (not weights or len(weights) == count and sum(weights) > 0)
        expect(
            good, f"{self._rule}: its weights", weights, f"{count} numbers >= 0 that are not all 0, or none, in a list"
        )
        return [float(weight) for weight in weights]

    def unused_settings(self) -> list[str]:
        """Return a warning for each setting that decides nothing."""
        rule, sampler = type(self.advance).__name__, type(self.sample).__name__
        if self.weights and not isinstance(self.sample, Current):
            return [f"curriculum.sample: {sampler} is not used while the weights of {rule} draw the levels."]
        is_set = self.given is not None or self.start_height is not None
        if (
            is_set
            and self.start < self.end
            and isinstance(self.advance, NoAdvance)
            and isinstance(self.sample, Current)
        ):
            key = "start_height" if self.given is None else "levels"
            return [f"curriculum.{key}: {rule} plays the last level only; expected another curriculum/advance."]
        return []

    def check_budget(self, total_frames: int, batch: int = 1) -> str | None:
        """Return a warning if the full task cannot be trained within ``total_frames``, else None.

        Args:
            total_frames: the run's budget.
            batch: frames of a batch; the level moves only after a batch.
        """
        if not self.levels.is_full:
            last = f"end_height={self.end}" if self.given is None else f"levels[{self.end - 1}]"
            return f"curriculum.{last}: the last level is not the full task, which validation and evaluation play."
        least = self.advance.least_frames(batch)
        if least < total_frames:
            return None
        expected = f"more than {least} frames" if least < math.inf else "a stage of that level"
        return (
            f"total_frames={total_frames}: the curriculum ({type(self.advance).__name__}, from level "
            f"{self.start}) cannot train at its last level {self.end}; expected {expected}."
        )

    def update(self, levels: Tensor, occupancy: Tensor, frames: int) -> dict:
        """Count a batch's finished episodes and move the level.

        Args:
            levels: their levels, int ``[E]``; E may be 0.
            occupancy: their final occupancies, float ``[E]``.
            frames: frames of the whole run, this batch included.

        Returns:
            Metrics to log: ``curriculum/level`` (from now on), ``/progress`` (0 at the first level, 1 at the last),
            ``/frames_at_level``, ``/episodes`` and ``/occupancy`` (number and windowed mean at the level; no mean
            without an episode), ``/occupancy_at_<level>`` (means of this batch), and the rule's own. Counts are
            those on which the rule decided; a change of level clears them afterwards.
        """
        tally, levels, occupancy = self.tally, levels.reshape(-1), occupancy.reshape(-1).double()
        at_level = occupancy[levels == tally.level].tolist()
        tally.latest = list(zip(levels.tolist(), occupancy.tolist(), strict=True))
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
        means = {number: occupancy[levels == number].mean().item() for number in levels.unique().tolist()}
        own = {
            "level": level,
            "frames_at_level": tally.level_frames,
            "episodes": tally.episodes,
            "progress": (level - self.start) / (self.end - self.start) if self.end > self.start else 1.0,
            **({"occupancy": tally.mean} if tally.window else {}),
            **{f"occupancy_at_{number}": mean for number, mean in means.items()},
        }
        taken = ", ".join(sorted(name for name in logs if name in own or OWN_MEAN.fullmatch(str(name))))
        refuse_if(taken, f"{self._rule}: it logs {taken}, which the curriculum logs itself; expected other names.")
        logs |= own
        if level != tally.level:
            if not (tally.episodes or self.weights):
                keys = "more frames for it (curriculum.advance), or a smaller env.num_envs"
                log.warning("no episode at %s %d has ended; expected %s.", self.level_name, tally.level, keys)
            self.tally = Tally(level, deque(maxlen=self.advance.window), frames, level_start=frames)
        return {f"curriculum/{key}": value for key, value in logs.items()}

    def _clamped(self, level) -> int:
        expect(is_whole(level), f"{self._rule}: its level", level, "a whole number")
        return min(max(int(level), self.start), self.end)

    def _rule_state(self) -> dict:
        """Return the rule's own state; raise if a checkpoint could not store it."""
        for key in self.advance.state_keys:
            expect(hasattr(self.advance, key), f"{self._rule}: state_keys", key, "the name of an attribute of the rule")
        state = {key: deepcopy(getattr(self.advance, key)) for key in self.advance.state_keys}
        for key, value in state.items():
            expect(_is_json(value), f"{self._rule}: its state has {key}", value, "what JSON holds, numbers finite")
            is_changed = key in self._numbers and not isinstance(value, Real)
            expect(not is_changed, f"{self._rule}: its state has {key}", value, "a number, as at the start")
        return state

    def state_dict(self) -> dict:
        """Return level, counts and the rule's own state as plain JSON types; JSON stores floats exactly."""
        counts = {key: value for key, value in vars(self.tally).items() if key != "latest"}
        return counts | {"window": list(self.tally.window), "advance": self._rule_state()}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a :meth:`state_dict`; call it after :meth:`setup`.

        Raises:
            ValueError: for the state of another advance rule, an unknown level, or anything that is no such state.
        """
        expect(
            isinstance(state, dict)
            and set(state) == {*vars(self.tally), "advance"} - {"latest"}
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
            fits = _is_json(value) and (name not in self._numbers or isinstance(value, Real))
            expect(fits, key(name), value, "a number")
        self.tally = Tally(level, window, frames, counts["level_start"], counts["episodes"])
        self.advance.load_state(deepcopy(rule))


def _is_json(value) -> bool:
    """Return whether JSON stores a value exactly."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_json(part) for key, part in value.items())
    if isinstance(value, list):
        return all(map(_is_json, value))
    return value is None or isinstance(value, bool | str) or (isinstance(value, int | float) and is_number(value))
