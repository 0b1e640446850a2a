"""Evaluation of planners on fixed item streams."""
