"""Reinforcement learning for packing with a suction robot: where to pick, where to place, and how to turn."""

import gymnasium

from pickplace.env import PickPlaceEnv
from pickplace.geometry import Failure, Item, Rules
from pickplace.robot import Plan, Planner

gymnasium.register(
    "pickplace/PickPlace-v0",
    entry_point="pickplace.gym:PickPlaceGymEnv",
    vector_entry_point="pickplace.gym:PickPlaceVectorEnv",
)

__version__ = "0.1.0"
__all__ = ["Failure", "Item", "PickPlaceEnv", "Plan", "Planner", "Rules", "__version__"]
