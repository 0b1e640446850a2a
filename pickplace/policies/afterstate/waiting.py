"""Encoding of the items that wait, for value networks."""

import torch
from torch import Tensor, nn

TYPICAL = 4.0  # side of an item in cells; divided by it, the features are near 1


class WaitingItems(nn.Module):
    """Encodes a set of any number of items by a sum over them (Zaheer et al., Deep Sets, 2017).

    The sum passes through a layer without a bias, whose weights start at zero. So an empty set has the code 0, and
    weights that were trained without waiting items still serve.

    Args:
        width: of the encoding.
        hidden: width of the layers before the sum.
    """

    def __init__(self, width: int, hidden: int = 64):
        super().__init__()
        self.each = nn.Sequential(nn.Linear(7, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.sum = nn.Linear(hidden, width, bias=False)
        nn.init.zeros_(self.sum.weight)

    def forward(self, items: Tensor, scale: Tensor) -> Tensor:
        """Return the encoding, float32 ``[N, width]``.

        Args:
            items: int64 ``[N, M, 5]``: x, y, w, d and h; rows of zeros are no items.
            scale: float32 ``[N, 3]`` or ``[3]``, the factors that convert w, d and h into cells.
        """
        exists = items[..., 4:] > 0
        w, d, h = (items[..., 2:] * scale.unsqueeze(-2) / TYPICAL).unbind(-1)
        # Volume and faces decide how well an item fits, and a small network cannot multiply.
        seen = torch.stack([w, d, h, w * d, w * h, d * h, w * d * h], -1)
        return self.sum((self.each(seen) * exists).sum(-2))
