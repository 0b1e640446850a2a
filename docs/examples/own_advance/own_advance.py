"""An advance rule of your own: the levels that are packed worst are played most often."""

from pickplace.training.curriculum.advance import Advance


class WorstFirst(Advance):
    """Draw each episode's level in proportion to the share of the tote that stays empty at that level.

    Args:
        keep: share of a level's mean that each further episode leaves as it was, 0 to 1.
    """

    state_keys = ("occupancy",)  # saved in checkpoints, so that a resume is exact

    def __init__(self, keep: float = 0.95):
        self.keep = keep

    def setup(self, start, end, total_frames):
        self.occupancy = {str(level): 0.0 for level in range(start, end + 1)}  # JSON has texts as keys
        return super().setup(start, end, total_frames)

    def update(self, tally):
        for level, occupancy in tally.latest:
            self.occupancy[str(level)] += (1 - self.keep) * (occupancy - self.occupancy[str(level)])
        worst = min(self.occupancy, key=self.occupancy.get)
        return int(worst), {"worst": self.occupancy[worst]}

    def weights(self):
        return [1.01 - mean for mean in self.occupancy.values()]
