"""Stability rules: whether what an item rests on keeps it stable, and where it may bear weight itself."""
