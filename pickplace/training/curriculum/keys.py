"""Keys of a level's settings. Torch is not imported, so that a misspelt key on a command line is refused at once."""

from collections.abc import Mapping, Sequence

from pickplace.common.errors import unknown_key
from pickplace.common.validate import short_text

#: The keys of a level.
KEYS = ("tote_height", "items", "rotations", "bin_items", "refill", "preview")


def check_keys(levels: Sequence[Mapping]) -> None:
    """Refuse a key that a level cannot set; ``ValueError`` names the level and the key."""
    for number, level in enumerate(levels):
        for key in level:
            if key not in KEYS:
                raise ValueError(_refusal(f"curriculum.levels[{number}]", key))


def _refusal(place: str, key) -> str:
    if key in ("bin_size", "tote_size", "gripper", "support", "reach", "height_unit"):
        return (
            f"{place}.{key}: a level sets {', '.join(KEYS)}. {key} stays the same in a run; for another one chain two "
            "runs: pickplace-train ... hydra.run.dir=outputs/first, then pickplace-train ... "
            "warm_start.weights=outputs/first."
        )
    return unknown_key(f"{place}.{short_text(key)}", dict.fromkeys(KEYS), f"{place}.")
