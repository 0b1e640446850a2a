"""Stability rules: whether an item is stable where it rests, and where its top bears weight."""
