"""Whole episodes of items, made once and kept while they are played."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

#: Greatest number of episodes that are kept, or twice the number played side by side if that is more.
MAX_CACHED_EPISODES = 1024


class EpisodeCache:
    """Cache of the sequences of episodes.

    Args:
        make: ``make(stream, seed, episode)`` returns the sequences of episodes ``[E]``, one for each.
        at_once: greatest number of episodes in one call of ``make``, for its memory.
    """

    def __init__(self, make: Callable[[str, Tensor, Tensor], Sequence[Sequence]], at_once: int):
        self._make, self._at_once = make, at_once
        self._kept: dict[tuple[str, int, int], Sequence] = {}

    def step_elements(self, stream: str, seed: Tensor, episode: Tensor, step: Tensor, end) -> list:
        """Return the element at a step of each episode, int64 ``[N]``; ``end`` after the last one."""
        seed, episode, step = torch.broadcast_tensors(seed, episode, step)
        sequences = self.sequences(stream, seed, episode)
        return [[*sequence[at : at + 1], end][0] for sequence, at in zip(sequences, step.tolist(), strict=True)]

    def sequences(self, stream: str, seed: Tensor, episode: Tensor) -> list[Sequence]:
        """Return the sequence of each episode, int64 ``[N]``."""
        keys = [(stream, *key) for key in zip(seed.tolist(), episode.tolist(), strict=True)]
        unseen = list(dict.fromkeys(key for key in keys if key not in self._kept))
        for start in range(0, len(unseen), self._at_once):
            some = unseen[start : start + self._at_once]
            made = self._make(stream, *torch.tensor([key[1:] for key in some]).unbind(1))
            self._kept.update(zip(some, made, strict=True))
        found = [self._kept[key] for key in keys]
        if len(self._kept) > max(MAX_CACHED_EPISODES, 2 * len(keys)):
            self._kept = {key: self._kept[key] for key in keys}
        return found
