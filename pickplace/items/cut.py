"""Sequences of items that are cut from a full container, so that a perfect packing of each is known to exist."""

import math
from itertools import product

import torch
from torch import Tensor

from pickplace.common.validate import one_of, refuse_above, size_tuple
from pickplace.items.distributions import MAX_KINDS, ItemDistribution, check_range, hashed_uniform, place_at_random
from pickplace.items.kept import EpisodeCache

#: Orders of arrival: CUT-1 and CUT-2.
ORDERS = ("z", "stacking")

#: Greatest side of a container, and greatest number of items of an episode: more would fill the memory.
MAX_SIDE, MAX_ITEMS = 200, 1000


class Cut(ItemDistribution):
    """Items cut from a full container: an episode's items tile it, so that an occupancy of 1 is possible.

    CUT-1 and CUT-2 of Zhao et al., "Online 3D Bin Packing with Constrained Deep Reinforcement Learning", AAAI 2021,
    arXiv 2006.14978, section 4 and Algorithm 3 of its supplement. The container is cut in two again and again: a piece
    with a side above the greatest is cut across such a side, drawn at random. The others are the items. They arrive

    * CUT-1, ``order="z"``: by the height of their lower faces in the container, lowest first, equal ones at random;
    * CUT-2, ``order="stacking"``: at random, but each item after all items on which it lies.

    The paper leaves the following open, and we chose:

    * How the place of a cut is drawn. Ours is uniform over the places that leave two parts which can be cut into
      allowed sides. Any place, as Algorithm 3 reads, also gives parts below the least side, which it never finishes.
    * What "random" means for the side to cut, for ties in CUT-1 and for the next item in CUT-2: ours is uniform.
    * What comes after the last item. The paper asks for a total volume of at least the container's; ours is equal to
      it, and the episode ends.
    * The generator and its seeds, so that the paper's test sequences cannot be repeated, only their distribution.

    Args:
        container: ``(W, D, H)`` that is cut, in cells and height units; the tote's size.
        sides: ``(least, greatest)`` side of an item, of widths, depths and heights alike.
        order: ``"z"`` or ``"stacking"``.

    Raises:
        ValueError: a bad value, or sides into which the container cannot be cut.
    """

    sequential = True

    def __init__(self, container=(10, 10, 10), sides=(2, 5), order="z"):
        self.order = one_of("items.order", order, ORDERS)
        self.container = size_tuple("items.container", container, 3, MAX_SIDE)
        least, greatest = check_range("items.sides", sides)
        key = f"items.container={[*self.container]}, items.sides={[least, greatest]}"
        self._greatest, longest = greatest, max(self.container)
        # A length can be cut into n allowed sides if it is between n * least and n * greatest, for some n.
        fits = [-(-length // greatest) * least <= length for length in range(longest + 1)]
        if bad := [side for side in self.container if not fits[side]]:
            raise ValueError(f"{key}: sides of {least} to {greatest} do not add up to {bad[0]}; expected some that do.")
        count = math.prod(side // least for side in self.container)
        refuse_above(f"{key}: an episode has up to", count, "items", MAX_ITEMS)
        self.longest_episode = count
        cuts = [
            [at for at in range(least, length - least + 1) if length > greatest and fits[at] and fits[length - at]]
            for length in range(longest + 1)
        ]
        arising: list[set[int]] = []  # the sides to which cuts of each length lead
        for length, places in enumerate(cuts):
            arising.append({length} if length <= greatest else set().union(*(arising[at] for at in places)))
        sides_of_items = [sorted(arising[side]) for side in self.container]
        refuse_above(f"{key}: the container gives", math.prod(map(len, sides_of_items)), "kinds of items", MAX_KINDS)
        self.sizes = torch.tensor(list(product(*sides_of_items)))
        self._num_cuts = torch.tensor([len(places) for places in cuts])
        self._cuts = torch.tensor([places + [0] * (longest - len(places)) for places in cuts])
        self._layers = self.container[2] // least
        self._kept = EpisodeCache(self._sizes, max(1, 2**22 // count**2))  # for the memory of `_arrival`

    def num_items(self, stream, seed, episode):
        return torch.tensor([*map(len, self._kept.sequences(stream, seed, episode))], device=episode.device)

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        _, across, along = hashed_uniform(stream, seed, episode, step, 3)
        size = self._kept.step_elements(stream, seed, episode, step, end=[0, 0, 0])
        sizes = torch.tensor(size, dtype=torch.int64, device=step.device).view(-1, 3)
        item = place_at_random(sizes, across, along, bin_size)
        return item.map(lambda part: torch.where(item.exists, part, 0))

    def _sizes(self, stream: str, seed: Tensor, episode: Tensor) -> list[list[list[int]]]:
        """Return the ``w, d, h`` of the items of whole episodes, see :meth:`boxes`."""
        return [boxes[:, 3:].tolist() for boxes in self.boxes(stream, seed, episode)]

    def boxes(self, stream: str, seed: Tensor, episode: Tensor) -> list[Tensor]:
        """Return the items of whole episodes at their places in the container, which they tile.

        Args:
            stream: family of item streams.
            seed, episode: int64 ``[E]``, on the CPU.

        Returns:
            For each episode int64 ``[n, 6]``, the ``x, y, z, w, d, h`` of its items in their order of arrival.
        """
        cut = self._cut(stream, seed, episode)
        # Row by row; within a row, lower items come first, so that a stable sort keeps an item after its supporters.
        index = torch.argsort(cut[0] * self.container[2] + cut[1][:, 2], stable=True)
        row, low, high, uniform = (part[index] for part in cut)
        counts = torch.bincount(row, minlength=len(episode))
        place = torch.arange(len(row)) - (counts.cumsum(0) - counts)[row]
        shape = len(episode), int(counts.max())

        low, high, uniform = (
            part.new_zeros(*shape, *part.shape[1:]).index_put((row, place), part) for part in (low, high, uniform)
        )
        time = low[..., 2] + uniform if self.order == "z" else self._arrival(low, high, uniform)
        time = time.masked_fill(torch.arange(shape[1]) >= counts[:, None], torch.inf)
        order = time.argsort(stable=True)[..., None].expand_as(low)
        boxes = torch.cat([low.gather(1, order), (high - low).gather(1, order)], -1)
        return [each[:count] for each, count in zip(boxes, counts.tolist(), strict=True)]

    def _cut(self, stream: str, seed: Tensor, episode: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the items of episodes, ``[B]`` in all: the episode's row, two corners ``[B, 3]``, a uniform number.

        All pieces are cut at once, round by round. A piece's random numbers depend only on its place in the
        container, so that the order of the cuts does not matter.
        """
        (_, depth, height), volume = self.container, math.prod(self.container)
        row, low = torch.arange(len(episode)), torch.zeros(len(episode), 3, dtype=torch.int64)
        high = low + torch.tensor(self.container)
        done = []
        while len(row):
            first, last = ((cell[:, 0] * depth + cell[:, 1]) * height + cell[:, 2] for cell in (low, high - 1))
            address = -1 - (first * volume + last)  # below 0: steps from 0 place the items in the bin
            side_number, place_number, order_number = hashed_uniform(stream, seed[row], episode[row], address, 3)
            rank = (high - low > self._greatest).cumsum(1)  # [B, 3]
            long = rank[:, -1] > 0
            done.append((row[~long], low[~long], high[~long], order_number[~long]))
            row, low, high, rank = row[long], low[long], high[long], rank[long]
            wanted = (side_number[long] * rank[:, -1]).long() + 1
            side = torch.searchsorted(rank, wanted[:, None])  # [B, 1]
            length = (high - low).gather(1, side)
            cut = self._cuts[length, (place_number[long, None] * self._num_cuts[length]).long()] + low.gather(1, side)
            row = torch.cat([row, row])
            low, high = torch.cat([low, low.scatter(1, side, cut)]), torch.cat([high.scatter(1, side, cut), high])
        return tuple(map(torch.cat, zip(*done, strict=True)))  # type: ignore[return-value]

    def _arrival(self, low: Tensor, high: Tensor, uniform: Tensor) -> Tensor:
        """Return times of arrival that give the order of CUT-2, float64 ``[E, K]``.

        Each item arrives an exponentially distributed time after the last item on which it lies. Because such a
        time has no memory, all items that may arrive next are equally likely.

        Args:
            low, high: int64 ``[E, K, 3]``, two corners of each item.
            uniform: float64 ``[E, K]``.
        """
        overlap = (low[:, :, None, :2] < high[:, None, :, :2]) & (low[:, None, :, :2] < high[:, :, None, :2])
        below = overlap.all(-1) & (high[:, :, None, 2] == low[:, None, :, 2])  # [E, below, above]
        time = wait = -torch.log1p(-uniform)
        for _ in range(self._layers - 1):
            time = wait + torch.where(below, time[:, :, None], 0).amax(1)
        return time
