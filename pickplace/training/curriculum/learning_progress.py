"""An advance rule that chooses among the levels by learning progress."""

from pickplace.common.validate import expect, integral_number, is_number, number
from pickplace.training.curriculum.advance import Advance


class LearningProgress(Advance):
    """Draw levels in proportion to their learning progress: a bandit over levels.

    The progress of a level is the difference between the mean occupancies of the newer and the older half of its latest
    episodes. So a level that is being learnt is played most. One that is mastered, or still too hard, is played rarely.
    A level whose occupancy falls is played again. It is the window algorithm of Matiisen et al., "Teacher-Student
    Curriculum Learning", 2017 (arXiv 1707.00183), with probabilities in proportion to the absolute progress, as
    ALP-GMM has them (Portelas et al. 2019, arXiv 1910.07224), for levels instead of a continuous space of tasks.

    Args:
        window: number of latest episodes of each level that count; a level with fewer counts as the most promising.
        explore: share of the episodes whose level is drawn uniformly.
    """

    state_keys = ("histories",)

    def __init__(self, window: int = 100, explore: float = 0.2):
        self.length = integral_number("curriculum.advance.window", window, 2, 100_000)
        self.explore = number("curriculum.advance.explore", explore, most=1)

    def setup(self, start, end, total_frames):
        self.histories: list[list[float]] = [[] for _ in range(start, end + 1)]  # of occupancies, the latest last
        return super().setup(start, end, total_frames)

    def update(self, tally):
        for level, occupancy in tally.latest:
            history = self.histories[level - self.start]
            history.append(occupancy)
            del history[: -self.length]
        weights = self.weights()
        return self.start + weights.index(max(weights)), {"learning_progress": max(self._progress())}

    def _progress(self) -> list[float]:
        half = self.length // 2
        known = [
            abs(sum(history[-half:]) - sum(history[:half])) / half if len(history) == self.length else None
            for history in self.histories
        ]
        most = max((each for each in known if each is not None), default=0.0) or 1.0
        return [most if each is None else each for each in known]

    def weights(self):
        progress = self._progress()
        total, count = sum(progress), len(progress)
        return [self.explore / count + (1 - self.explore) * (each / total if total else 1 / count) for each in progress]

    def load_state(self, state):
        histories, expected = state["histories"], "lists of occupancies, one for each level"
        good = (
            isinstance(histories, list)
            and len(histories) == len(self.histories)
            and all(isinstance(history, list) for history in histories)
            and all(is_number(value) and 0 <= value <= 1 for history in histories for value in history)
        )
        expect(good, "curriculum histories of the checkpoint", histories, expected)
        self.histories = [history[-self.length :] for history in histories]  # a resumed run's window may be shorter
