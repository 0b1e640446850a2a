"""The robot's reach, as tables of limits: from a formula, or from a file."""
