"""Policies over joint (pick, place, rotation) actions."""
