"""Policies whose pick is heuristic."""
