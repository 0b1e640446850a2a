"""Reinforcement learning for packing with a suction robot: where to pick, where to place, and how to turn."""

from importlib import import_module
from typing import TYPE_CHECKING

import gymnasium

if TYPE_CHECKING:
    from pickplace.envs.torchrl import PickPlaceEnv
    from pickplace.robot.planner import DepthMapError, Plan, Planner
    from pickplace.task.geometry import Failure, Item, Rules

gymnasium.register(
    "pickplace/PickPlace-v0",
    entry_point="pickplace.envs.gymnasium:PickPlaceGymEnv",
    vector_entry_point="pickplace.envs.gymnasium:PickPlaceVectorEnv",
)

__version__ = "0.1.0"
__all__ = ["DepthMapError", "Failure", "Item", "PickPlaceEnv", "Plan", "Planner", "Rules", "__version__"]

_HOMES = {"PickPlaceEnv": "envs.torchrl", "Failure": "task.geometry", "Item": "task.geometry", "Rules": "task.geometry"}
_HOMES |= {"DepthMapError": "robot.planner", "Plan": "robot.planner", "Planner": "robot.planner"}


def __getattr__(name: str):
    """What the package offers is imported when it is asked for: torch and torchrl take seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pickplace.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
