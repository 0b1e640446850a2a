"""The items, sizes and rules of a policy's training, and warnings about scenes outside them."""

from dataclasses import dataclass
from typing import cast

from omegaconf import DictConfig, OmegaConf

from pickplace.items.distributions import ItemDistribution
from pickplace.policies.restore import build_cell, cell_settings, differences
from pickplace.rules.cell import CellSpec
from pickplace.rules.state import State

#: Options of the cell, beside the sizes, that should be the same as in a policy's training.
RULES = ("support", "gripper")


@dataclass(frozen=True)
class TrainingEnvelope:
    """The items and the sizes of a policy's training.

    Attributes:
        kinds: every size ``(w, d, h)`` of its items, in cells and height units.
        cell: the sizes, with the highest tote, and the rules of the training.
    """

    kinds: frozenset[tuple[int, int, int]]
    cell: CellSpec

    @classmethod
    def of(cls, config: DictConfig, items: ItemDistribution) -> "TrainingEnvelope":
        """Return the envelope that a checkpoint's config states."""
        kinds = frozenset((int(w), int(d), int(h)) for w, d, h in items.sizes.tolist())
        # No table of reach is read, as its file may be missing here.
        return cls(kinds, build_cell(cast(dict, OmegaConf.to_container(config.env, resolve=True)), reach=None))

    def warnings(self, cell: CellSpec, state: State) -> list[str]:
        """Return a sentence for each thing that the policy never met: an item, the tote, the end effector, the rule.

        Args:
            cell: the sizes, but for the tote's height.
            state: of one problem, as the policy sees it.
        """
        items, tote_size = state.items, (*cell.tote_size[:2], int(state.tote_height))
        known, longest = self.cell, [max(kind[axis] for kind in self.kinds) for axis in range(3)]
        found = sorted(
            {
                f"item of {w}x{d}x{h} cells: the policy met other sizes, up to {_sides(longest)}."
                for w, d, h in items.cuboids[0, :, 2:].tolist()
                if not {(w, d, h), (d, w, h)} & self.kinds
            }
        )
        if (count := items.x.shape[1]) > known.bin_items:
            found.append(f"{count} items in the bin: the policy met at most {known.bin_items}.")
        if known.tote_size[:2] != tote_size[:2] or tote_size[2] > known.tote_size[2]:
            found.append(f"tote of {_sides(tote_size)} cells: the policy met {_sides(known.tote_size)}.")
        return found + [
            f"{key}={ours}: the policy met {key}={theirs}."
            for key, ours, theirs in differences(cell_settings(cell, RULES), cell_settings(known, RULES))
            if key != "gripper.size" or sorted(ours) != sorted(theirs)
        ]


def _sides(sizes) -> str:
    return "x".join(map(str, sizes))
