"""What the node remembers: what was placed, and which picks failed. See docs/robot.md, "From images to motions"."""

from pickplace import Box, Plan


class Record:
    """The tote's contents, the picks that failed, and the plan that the robot carries out.

    Attributes:
        bearing: ``tote_bearing`` of the last plan that was carried out; None: it is not known.
        placed_boxes: the items that lie in the tote as planned.
        excluded: centres of the picks that failed, in the bin's frame, m.
        open: the newest plan that is ok, until the robot has reported what became of it.
    """

    #: The services: the name, and what the robot reports with it.
    EVENTS = ("placed", "pick_failed", "bin_changed", "new_tote")

    def __init__(self):
        self.bearing: list[list[int]] | None = None
        self.placed_boxes: list[Box] = []
        self.excluded: list[tuple[float, float, float]] = []
        self.open: Plan | None = None

    def placed(self) -> None:
        """The item lies in the tote as the open plan says."""
        plan = self._take()
        self.bearing, self.excluded = plan.tote_bearing, []
        self.placed_boxes.append(plan.placed)

    def pick_failed(self) -> None:
        """The lift of the open plan brought nothing: do not plan this pick again."""
        self.excluded.append(self._take().pick.center)

    def bin_changed(self) -> None:
        """The items in the bin lie elsewhere: one slipped and was set down, or somebody reached in."""
        self.excluded, self.open = [], None

    def new_tote(self) -> None:
        """The tote is an empty one, or nobody knows what lies in it: an item fell into it."""
        self.bearing, self.placed_boxes, self.open = None, [], None

    def _take(self) -> Plan:
        """Return the open plan, and close it.

        Raises:
            ValueError: if there is none.
        """
        plan, self.open = self.open, None
        if plan is None:
            raise ValueError("no plan is open; expected one report after each plan that is ok.")
        return plan
