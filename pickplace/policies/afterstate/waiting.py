"""What a value network sees of the items that wait."""

import torch
from torch import Tensor, nn

TYPICAL = 4.0  # a side in cells, so that the features are about one


class WaitingItems(nn.Module):
    """Encodes a set of items, in any number: a sum over them, as of Zaheer et al., Deep Sets (2017).

    The sum passes through a layer without a bias that starts at zero. So no item is no sum, and weights that know no
    waiting items go on as they are.

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
            scale: float32 ``[N, 3]`` or ``[3]``, by which w, d and h are multiplied, to be cells.
        """
        exists = items[..., 4:] > 0
        w, d, h = (items[..., 2:] * scale.unsqueeze(-2) / TYPICAL).unbind(-1)
        # Small networks do not multiply: the volume, and the faces, decide how well an item fits.
        seen = torch.stack([w, d, h, w * d, w * h, d * h, w * d * h], -1)
        return self.sum((self.each(seen) * exists).sum(-2))
