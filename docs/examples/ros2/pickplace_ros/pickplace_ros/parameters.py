"""The node's parameters, and the planner that they name."""

from argparse import Namespace
from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException

from pickplace import Planner
from pickplace.common.validate import refuse_if, reword_errors
from pickplace.robot.box import ACCURACY, CLEARANCE
from pickplace.serve.options import load_planner, plan_once, planner_options
from pickplace.serve.request import DEADLINE, MAX_DEADLINE

LEAST_DEADLINE = 0.001  # s


class Setting(NamedTuple):
    """A parameter."""

    default: Any  # it has the parameter's type
    description: str
    least: float | None = None
    most: float | None = None
    null: Any = None  # the value that stands for null, which ROS does not have


PARAMETERS = {
    "checkpoint": Setting("pretrained/mixed", "a run folder, a checkpoint, or pretrained/<name>; empty: none", null=""),
    "planner": Setting("", "what decides, such as joint_dbl; empty: the policy of the checkpoint", null=""),
    "gripper": Setting("", "an option of conf/gripper, or a file such as those there; empty: as trained", null=""),
    "support": Setting("", "an option of conf/support, or a file such as those there; empty: as trained", null=""),
    "reach": Setting("", "an option of conf/reach, or a file such as those there; empty: as trained", null=""),
    "bin_size": Setting([0, 0, 0], "cells along x, y and z; zeros: as trained", null=[0, 0, 0]),
    "tote_size": Setting([0, 0, 0], "cells along x, y and z; zeros: as trained", null=[0, 0, 0]),
    "rotations": Setting(0, "quarter turns to choose from, 1 to 4; 0: as trained", 0, 4, null=0),
    "device": Setting("cpu", "cpu or cuda"),
    "cell_size": Setting(0.05, "side of a cell, m", 0.001, 10.0),
    "accuracy": Setting(ACCURACY, "greatest error of a measured height, m", 0.0, 0.1),
    "clearance": Setting(CLEARANCE, "least distance from what stands beside the item, m", 0.0, 0.1),
    "placement_error": Setting(
        CLEARANCE, "greatest distance of an item from where it is set down, m; at most the clearance", 0.0, 0.1
    ),
    "bin_height": Setting(0.0, "height of the bin's walls above its floor, m; 0: that of bin_size", 0.0, 2.0, null=0),
    "tote_height": Setting(0.0, "height of the tote's rim above its floor, m; 0: that of tote_size", 0.0, 2.0, null=0),
    "greatest_height": Setting(0.0, "of an item, m; 0: the height of the tote's rim", 0.0, 2.0, null=0),
    "longest_age": Setting(
        0.0, "greatest age of an image when the goal arrives, s; 0: images are taken after that", 0.0, 3600.0
    ),
    "deadline": Setting(
        DEADLINE, "greatest time until the result of a goal that names none, s", LEAST_DEADLINE, MAX_DEADLINE
    ),
    "bin_frame": Setting("bin", "frame whose origin is the corner of the bin's cell (0, 0)"),
    "tote_frame": Setting("tote", "frame whose origin is the corner of the tote's cell (0, 0)"),
}


def declare(node) -> dict[str, Any]:
    """Declare the parameters of a node, all of them read-only, and return their values; None for null.

    Raises:
        ValueError: for a value of another type, out of its range, or empty.
    """
    values = {}
    for name, (default, description, least, most, null) in PARAMETERS.items():
        descriptor = ParameterDescriptor(name=name, description=description, read_only=True)
        if isinstance(default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=least, to_value=most)]
        elif least is not None:
            descriptor.integer_range = [IntegerRange(from_value=least, to_value=most, step=1)]
        with reword_errors(ParameterException, lambda error: ValueError(str(error))):
            value = node.declare_parameter(name, default, descriptor).value
        value = list(value) if isinstance(default, list) else value
        refuse_if(value == "" and null is None, f"{name}: empty; expected {description}.")
        values[name] = None if value == null else value
    return values


def load(values: dict[str, Any]) -> Planner:
    """Return the planner that the parameters name; it has planned once, so that the first goal is no slower.

    Raises:
        ValueError: naming the parameter, or the file, that cannot be used.
    """
    options = {name.lstrip("-").replace("-", "_"): option for name, option in planner_options().items()}
    given = {name: option.get("default") for name, option in options.items()}
    given |= {name: value for name, value in values.items() if name in options}
    with reword_errors(ValueError, lambda error: ValueError(str(error).replace("--", ""))):
        planner, _ = load_planner(Namespace(**given))
    plan_once(planner)
    return planner
