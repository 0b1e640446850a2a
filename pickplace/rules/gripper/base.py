"""The gripper: a body that must hit nothing, a cup that grips, and a rule for when it grips an item."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.common.validate import excerpt, expect, size_tuple
from pickplace.rules.gripper.shapes import Box, Mask, Polygon, boxes, centred, parts, read_shape, turned

MAX_GRIPPER = 64  # greatest side of a gripper, in cells


def reference_cell(side):
    """Return the gripper's reference cell along a side, counted from its minimum corner; an int or a tensor."""
    return (side - 1) // 2


def effector_centre(at, side):
    """Return the gripper's centre along a side, with its reference cell at ``at``; in cells, numbers or tensors.

    The centre is that of the rectangle; with an even side, the reference cell's middle is half a cell off.
    """
    return at - reference_cell(side) + side / 2


class EffectorShape(NamedTuple):
    """The gripper as it is turned: its sides, its reference cell and the rectangles of its body, in cells."""

    width: int
    depth: int
    ref_x: int
    ref_y: int
    body: tuple[Box, ...]


@dataclass(frozen=True)
class Gripper(ABC):
    """A gripper: body and cup, in a rectangle of cells, and a grip rule.

    A grip rule of your own is a subclass with :attr:`least_cells`, and a config file: ``gripper: {_target_:
    my_module.MyRule, size: [3, 3]}``. If the number of the cup's cells on the item is not enough to decide, override
    :meth:`is_gripped`, too. Further fields of the dataclass are settings; they must be numbers, texts or tuples.

    Args:
        size: ``(W_E, D_E)`` of the rectangle around the gripper.
        body: the cells of ``size`` that must not hit anything: ``"rectangle"``, all; ``"disc"``, those that the ellipse
            inscribed in it touches; or a mask, ``W_E`` lists of ``D_E`` times 0 or 1, with a 1 on each edge.
        cup: the cells that grip the item: ``"rectangle"`` or ``"disc"`` of ``cup_size``, or a mask as ``body``'s. They
            must be cells of the body.
        cup_size: ``(w, d)`` of the cup, in the middle of the body; None: ``size``. It must be None with a mask.

    Raises:
        ValueError: naming the argument, the value received and what was expected.
    """

    misfit = "the cup does not fit on this item"  # the reason if an item cannot be gripped

    size: tuple[int, int] = (3, 3)
    body: str | Mask = "rectangle"
    cup: str | Mask = "rectangle"
    cup_size: tuple[int, int] | None = None

    def __post_init__(self):
        object.__setattr__(self, "size", size_tuple("gripper.size", self.size, 2, MAX_GRIPPER))
        for key in ("body", "cup"):
            object.__setattr__(self, key, read_shape(f"gripper.{key}", getattr(self, key), self.size))
        lines_of_body = self.body_mask, tuple(zip(*self.body_mask, strict=True))
        touches = all(any(line) for lines in lines_of_body for line in (lines[0], lines[-1]))
        lists = "a 1 in its first and last list, and first and last in some list"
        expect(touches, "gripper.body", self.body, f"{lists}; a smaller body needs a smaller size")
        if self.cup_size is not None:
            sides = [*size_tuple("gripper.cup_size", self.cup_size, 2, MAX_GRIPPER)]
            object.__setattr__(self, "cup_size", tuple(sides))
            expect(isinstance(self.cup, str), "gripper.cup_size", sides, "null, as cup is a mask")
            centred = all(cup <= body and (body - cup) % 2 == 0 for cup, body in zip(sides, self.size, strict=True))
            even = f"sides that differ from size={[*self.size]} by an even number of cells"
            expect(centred, "gripper.cup_size", sides, f"{even}, so that the cup is centred in the body")
        columns = enumerate(zip(self.body_mask, self.cup_mask, strict=True))
        if outside := [(x, y) for x, (body, cup) in columns for y in range(len(body)) if cup[y] > body[y]]:
            raise ValueError(
                f"gripper.cup={excerpt(self.cup)}, cup_size={excerpt(self.cup_size)}: cell {outside[0]} of the cup is "
                f"not in body={excerpt(self.body)}; expected a cup that is part of the body."
            )

    # ------------------------------------------------------------------ the grip rule
    @property
    @abstractmethod
    def least_cells(self) -> int:
        """Lower bound of the number of the cup's cells on a gripped item, whatever the item's size."""

    @property
    def largest_item(self) -> tuple[int, int] | None:
        """Greatest sides of an item that may be gripped, along x and y, before turning; None: there is no limit."""
        return None

    def is_gripped(self, near_x: Tensor, near_y: Tensor, w: Tensor, d: Tensor, inset: tuple[int, int]) -> Tensor:
        """Return whether the gripper grips the item: by default, if at least :attr:`least_cells` of the cup lie on it.

        Args:
            near_x, near_y: from the gripper's minimum corner to the item's, before turning, in cells; negative if the
                item begins before it. They broadcast.
            w, d: sides of the item.
            inset: cells at each edge of the item, along x and y, that a measured item may cover only in part.
        """
        if any(inset):
            x, y = inset
            near_x, near_y, w, d = near_x + x, near_y + y, w - 2 * x, d - 2 * y
        return self.count_cells(self.shared_sides(near_x, near_y, w, d)) >= self.least_cells

    def can_grip(self, w: int, d: int, inset: tuple[int, int] = (0, 0)) -> bool:
        """Return whether an item of ``w x d`` cells can be gripped somewhere; for ``inset`` see :meth:`is_gripped`."""
        near_x, near_y = (torch.arange(1 - side, own) for side, own in zip((w, d), self.size, strict=True))
        return bool(self.is_gripped(near_x[:, None], near_y, torch.tensor(w), torch.tensor(d), inset).any())

    def shared_sides(self, near_x: Tensor, near_y: Tensor, w: Tensor, d: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the number of cells, along x and y, that an item and each box of the cup share; negative if apart."""

        def shared(near: Tensor, side: Tensor, begin: int, length: int) -> Tensor:
            return (near + side).clamp_(max=begin + length) - near.clamp(min=begin)

        return [(shared(near_x, w, box.x, box.width), shared(near_y, d, box.y, box.depth)) for box in self.cup_boxes]

    @staticmethod
    def count_cells(shared: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Return the number of the cup's cells that lie on an item, from :meth:`shared_sides`."""
        return reduce(torch.add, [x.clamp(min=0) * y.clamp(min=0) for x, y in shared])

    def offsets(self, longest: int, rotations: int) -> range:
        """Return the range of an item's offsets under the gripper that a grip allows, along either axis, in any turn.

        The lines of cells that a gripped item covers contain at least :attr:`least_cells` of the cup.

        Args:
            longest: longest side of any item.
            rotations: number of quarter turns to choose from.
        """
        counts = [[*map(sum, lines)] for lines in self.cup_lines]
        counts += [line[::-1] for line in counts] if rotations > 1 else []
        places = ((at, line[max(at, 0) : at + longest]) for line in counts for at in range(1 - longest, len(line)))
        found = [at for at, covered in places if sum(covered) >= self.least_cells]
        return range(min(found), max(found) + 1) if found else range(1)

    # ------------------------------------------------------------------ body and cup
    @cached_property
    def body_mask(self) -> Mask:
        """The cells of the body, before turning."""
        return centred(self.body, self.size, self.size)

    @cached_property
    def cup_mask(self) -> Mask:
        """The cells of the cup, before turning."""
        return centred(self.cup, self.cup_size or self.size, self.size)

    @cached_property
    def body_parts(self) -> tuple[Polygon, ...]:
        """Convex polygons that cover the body, before turning, in cells from its centre; for turns by any angle."""
        return parts(self.body, self.size)

    @property
    def cup_lines(self) -> tuple[Mask, Mask]:
        """The cup's lines of cells: one for each x, and one for each y."""
        return self.cup_mask, tuple(zip(*self.cup_mask, strict=True))

    @cached_property
    def cup_boxes(self) -> tuple[Box, ...]:
        """Rectangles that do not overlap and make up the cup, before turning."""
        return boxes(self.cup_mask)

    def shapes(self, rotations: int) -> tuple[EffectorShape, ...]:
        """Return the distinct shapes of the turned body: 1, 2 or ``rotations`` of them."""
        masks = [self.body_mask]
        for _ in range(rotations - 1):
            masks.append(turned(masks[-1]))
        count = next(n for n in (1, 2, len(masks)) if masks == [masks[r % n] for r in range(len(masks))])
        sides = [self.size[:: -1 if turn % 2 else 1] for turn in range(count)]
        return tuple(
            EffectorShape(width, depth, reference_cell(width), reference_cell(depth), boxes(mask))
            for (width, depth), mask in zip(sides, masks, strict=False)
        )
