"""The planner for a robot cell."""
