"""The exact optimum on totes of height 1, by dynamic programming over every state of the tote.

With all heights 1, neither the rim nor an item in the tote is ever higher than a placed item's top. So the end effector
never collides, and a state is the set of filled cells. Written from the rules, without any code of the package.
"""

from functools import cache

PAPER_SIDES = ((1, 1), (2, 1), (1, 2), (2, 2))


def optimal_occupancy(width: int, depth: int, rotations: int, sides=PAPER_SIDES) -> float:
    """Greatest expected occupancy of a ``width x depth x 1`` tote, if all sides of items are equally likely."""

    def footprints(w, d):
        """Bit masks of every position of a ``w x d`` footprint."""
        masks = []
        for x in range(width - w + 1):
            for y in range(depth - d + 1):
                masks.append(sum(1 << ((x + i) * depth + y + j) for i in range(w) for j in range(d)))
        return masks

    choices = []
    for w, d in sides:
        turns = {(w, d)} | ({(d, w)} if rotations > 1 else set())
        choices.append((w * d, sorted({mask for turn in turns for mask in footprints(*turn)})))

    @cache
    def value(filled: int) -> float:
        """Expected volume that can still be placed until an item arrives that fits nowhere."""
        total = 0.0
        for area, masks in choices:
            total += max((area + value(filled | mask) for mask in masks if not filled & mask), default=0.0)
        return total / len(choices)

    return value(0) / (width * depth)
