"""Grippers: the shapes of body and cup, and one class for each grip rule."""
