"""Reinforcement learning for packing with a suction robot: where to pick, where to place, and how to turn."""

import os
import signal
import sys
from importlib import import_module
from typing import TYPE_CHECKING

_is_command = os.path.basename(next(iter(sys.argv), "")).startswith("pickplace-")
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))  # Ctrl-C prints no traceback; cli.py replaces this handler

import gymnasium  # noqa: E402

if TYPE_CHECKING:
    from pickplace.envs.torchrl import PickPlaceEnv
    from pickplace.policies.restore import load_policy
    from pickplace.robot.box import Box, DepthMapError, EmptyBinError
    from pickplace.robot.camera import Camera
    from pickplace.robot.planner import Plan, Planner
    from pickplace.robot.scene import Scene
    from pickplace.rules.cell import CellSpec
    from pickplace.rules.item import Item
    from pickplace.rules.state import Failure, State

gymnasium.register(
    "pickplace/PickPlace-v0",
    entry_point="pickplace.views.gymnasium:RenderedPickPlaceEnv",
    vector_entry_point="pickplace.envs.gymnasium:PickPlaceVectorEnv",
    order_enforce=False,  # a wrapper would hide action_masks(); the environment itself refuses a step before reset
    disable_env_checker=True,
)

__version__ = "0.1.0"

#: The module of each public name. It is imported on first use, as torch and torchrl take seconds.
_MODULES = {
    "Box": "robot.box",
    "Camera": "robot.camera",
    "CellSpec": "rules.cell",
    "DepthMapError": "robot.box",
    "EmptyBinError": "robot.box",
    "Failure": "rules.state",
    "Item": "rules.item",
    "PickPlaceEnv": "envs.torchrl",
    "Plan": "robot.planner",
    "Planner": "robot.planner",
    "Scene": "robot.scene",
    "State": "rules.state",
    "load_policy": "policies.restore",
}
__all__ = [
    "Box", "Camera", "CellSpec", "DepthMapError", "EmptyBinError", "Failure", "Item", "PickPlaceEnv", "Plan", "Planner",
    "Scene", "State", "__version__", "load_policy",
]  # fmt: skip


def __getattr__(name: str):
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pickplace.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
