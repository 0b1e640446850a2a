"""Carry out plans in MuJoCo, which does not use our rules."""
