"""Settings of a robot cell."""

CELL_SETTINGS = ("bin_size", "tote_size", "effector_size", "rotations", "pick_rule", "min_support", "strict_support")
