"""Planners: everything that decides where to pick, where to place and how to turn, behind one protocol."""
