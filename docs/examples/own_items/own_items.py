"""An item distribution of your own: several items of the same kind arrive in a row."""

from pickplace.items.distributions import Kinds, hashed_uniform


class Batches(Kinds):
    """Kinds of which ``run`` items arrive in a row, each at a position of its own.

    Args:
        kinds: ``(w, d, h)`` triples, in cells.
        run: number of items of the same kind in a row.
        weights: a relative frequency for each kind; None: equally likely.
    """

    def __init__(self, kinds, run: int, weights=None):
        super().__init__(kinds, weights)  # sets `sizes`, int64 [K, 3]: all sizes that may arrive
        if not isinstance(run, int) or run < 1:
            raise ValueError(f"items.run={run!r}: expected a whole number >= 1.")
        self.run = run

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        """Return the ``step``-th item of each episode, int64 ``[N]``; a function of its arguments alone."""
        (kind,) = hashed_uniform(stream, seed, episode, step // self.run, 1)
        _, across, along = hashed_uniform(stream, seed, episode, step, 3)
        return self.of_kind(self._index(kind, step, mix), across, along, bin_size)
