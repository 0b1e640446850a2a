"""Reinforcement learning for packing with a suction robot: where to pick, where to place, and how to turn."""

from importlib import import_module
from typing import TYPE_CHECKING

import gymnasium

if TYPE_CHECKING:
    from pickplace.env import PickPlaceEnv
    from pickplace.geometry import Failure, Item, Rules
    from pickplace.robot import DepthMapError, Plan, Planner

gymnasium.register(
    "pickplace/PickPlace-v0",
    entry_point="pickplace.gym:PickPlaceGymEnv",
    vector_entry_point="pickplace.gym:PickPlaceVectorEnv",
)

__version__ = "0.1.0"
__all__ = ["DepthMapError", "Failure", "Item", "PickPlaceEnv", "Plan", "Planner", "Rules", "__version__"]

_HOMES = {"PickPlaceEnv": "env", "Failure": "geometry", "Item": "geometry", "Rules": "geometry"}
_HOMES |= {"DepthMapError": "robot", "Plan": "robot", "Planner": "robot"}


def __getattr__(name: str):
    """What the package offers is imported when it is asked for: torch and torchrl take seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pickplace.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
