"""A callback of your own: the worst validation episode is logged, and ends the training when it is good enough."""

from pickplace.training.callbacks import Callback


class WorstEpisode(Callback):
    """End the training when every episode of some validations in a row is good enough.

    Args:
        occupancy: of the worst episode, 0 to 1.
        times: validations in a row.
    """

    def __init__(self, occupancy: float, times: int = 2):
        self.occupancy, self.times, self.reached = occupancy, times, 0

    def on_validation(self, trainer, episodes, metrics):
        """Log ``eval/worst``; ``episodes.occupancy`` is float32 ``[E]``."""
        worst = float(episodes.occupancy.min())
        metrics["eval/worst"] = worst
        self.reached = self.reached + 1 if worst >= self.occupancy else 0
        if self.reached >= self.times:
            trainer.end(f"the worst episode has reached {self.occupancy} {self.reached} times in a row")

    def state_dict(self):
        return {"reached": self.reached}  # for an exact resume

    def load_state_dict(self, state):
        self.reached = int(state["reached"])
