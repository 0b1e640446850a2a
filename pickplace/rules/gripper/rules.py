"""The grip rules, one class each, and the short form that names them."""

from dataclasses import dataclass, fields
from functools import cached_property

from torch import Tensor

from pickplace.common.validate import expect, is_number, one_of
from pickplace.rules.gripper.base import Gripper


@dataclass(frozen=True)
class Contain(Gripper):
    """Grip an item that the cup covers completely, uncertain edges included."""

    least_cells = 1
    misfit = "the cup does not cover this item"

    @property
    def largest_item(self) -> tuple[int, int]:
        filled = ([at for at, line in enumerate(lines) if any(line)] for lines in self.cup_lines)
        w, d = (line[-1] + 1 - line[0] for line in filled)
        return w, d

    def is_gripped(self, near_x: Tensor, near_y: Tensor, w: Tensor, d: Tensor, inset: tuple[int, int]) -> Tensor:
        shared = self.shared_sides(near_x, near_y, w, d)
        if len(shared) == 1:  # the same test along each axis, which is faster
            return (shared[0][0] == w) & (shared[0][1] == d)
        return self.count_cells(shared) >= w * d

    def offsets(self, longest: int, rotations: int) -> range:
        return super().offsets(1, rotations)  # the item begins in a line with a cell of the cup


@dataclass(frozen=True)
class Overlap(Gripper):
    """Grip an item on which at least one cell of the cup lies."""

    least_cells = 1


@dataclass(frozen=True)
class Seal(Gripper):
    """Grip an item on which at least a share of the cup's cells lies.

    Args:
        min_seal: the least share, above 0.
    """

    min_seal: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        good = is_number(self.min_seal) and 0 < self.min_seal <= 1
        expect(good, "gripper.min_seal", self.min_seal, "a number > 0 and <= 1")

    @cached_property
    def least_cells(self) -> int:
        total = sum(map(sum, self.cup_mask))
        return next(n for n in range(1, total + 1) if n / total >= self.min_seal)


#: Grip rules by their names in Python's short form.
GRIP_RULES: dict[str, type[Gripper]] = {"contain": Contain, "overlap": Overlap, "seal": Seal}


def changed_gripper(gripper: Gripper, pick_rule: str | None = None, **settings) -> Gripper:
    """Return a gripper with another grip rule, a key of :data:`GRIP_RULES`, or with other settings.

    Values that are None change nothing; a setting that the rule does not have is ignored.
    """
    rule = type(gripper) if pick_rule is None else GRIP_RULES[one_of("pick_rule", pick_rule, GRIP_RULES)]
    known = [field.name for field in fields(rule)]
    given = {key: value for key, value in settings.items() if value is not None and key in known}
    if rule is type(gripper) and not given:
        return gripper
    return rule(**{key: getattr(gripper, key) for key in known if hasattr(gripper, key)} | given)
