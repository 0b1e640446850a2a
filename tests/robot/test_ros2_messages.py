"""Messages of the ROS package: depth images, cameras and plans, each by another way than that of the node."""

import math
import sys
from array import array
from dataclasses import fields, replace

import numpy as np
import pytest
import ros_stand_ins as ros
from hypothesis import given
from hypothesis import strategies as st

from pickplace import Box, CellSpec, Plan, Planner, Scene

IMAGE, INFO = ros.message_class("sensor_msgs/msg/Image"), ros.message_class("sensor_msgs/msg/CameraInfo")
TRANSFORM = ros.message_class("geometry_msgs/msg/Transform")
TIME = ros.message_class("builtin_interfaces/msg/Time")


@pytest.fixture(scope="module")
def modules():
    with ros.installed() as found:
        yield found


def test_statuses_without_an_action(modules):
    planner = Planner(CellSpec(tote_size=(6, 6, 5)), planner="joint_dbl")
    view = modules.messages.View(None, None, "frame", TIME())
    item, full = Box(0.1, 0.12, 0.08, 0.08, 0.06), np.zeros((6, 6))
    stuck = planner.plan(Scene([item], full, 0.05))
    message = modules.messages.plan_message(stuck, view, view, (6, 6))
    ros.written(message)
    assert (message.status, message.item_number, message.action) == (message.STUCK, -1, -1)
    assert {reason.name: reason.count for reason in message.reasons} == stuck.reasons
    rows = replace(stuck, tote_bearing=[[1, 0], [0, 0], [1, 1]])
    assert modules.messages.plan_message(rows, view, view, (3, 2)).tote_bearing == [1, 0, 0, 0, 1, 1]
    assert message.box.size.x == 0.08 and message.placed.size.z == 0 and message.pick.header.frame_id == ""
    wide = Planner(CellSpec(tote_size=(6, 6, 5), cup_size=(1, 1), pick_rule="seal"), planner="joint_dbl")
    none = wide.plan(Scene([replace(item, w=0.03), replace(item, w=0.03, x=0.2)], full, 0.05))
    message = modules.messages.plan_message(none, view, view, (6, 6))
    ros.written(message)
    assert message.status == message.IMPOSSIBLE and message.hints == none.hints != []
    assert message.box.size.x == 0


def test_the_message_has_every_field_of_a_plan(modules):
    """Another field of a plan asks for a decision."""
    named = {field.name for field in fields(Plan)}
    message = set(ros.message_class("pickplace_interfaces/msg/Plan").KINDS)
    assert named - message == {"alternatives", "item", "rotation_degrees"}
    assert message - named == {"rotation", "tote_cells"}


@given(
    st.sampled_from(["16UC1", "32FC1"]), st.booleans(), st.integers(1, 4), st.integers(1, 5), st.integers(0, 7),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_every_layout_of_a_depth_image_is_read(modules, encoding, is_bigendian, height, width, padding, seed):
    """Rows of pixels, written one by one with ``array`` and ``byteswap``."""
    draw = np.random.default_rng(seed)
    values = draw.integers(0, 2**16, (height, width)).tolist()
    data = bytearray()
    for row in values:
        pixels = array("H" if encoding == "16UC1" else "f", row)
        if is_bigendian != (sys.byteorder == "big"):
            pixels.byteswap()
        data += pixels.tobytes() + bytes(padding)
    image = IMAGE(
        height=height, width=width, step=len(data) // height, encoding=encoding, is_bigendian=int(is_bigendian),
        data=array("B", data),
    )  # fmt: skip
    unit = 0.001 if encoding == "16UC1" else 1
    assert modules.messages.depth_of(image, "depth") == pytest.approx(np.array(values) * unit)


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: math.hypot(*axis) > 0.1), st.floats(-0.9, 0.9),
    st.tuples(*[st.floats(-2, 2)] * 3),
)  # fmt: skip
def test_the_pose_of_the_camera_is_that_of_tf(modules, axis, tilt, shift):
    """A pixel's point agrees with the formula v + 2 w (q x v) + 2 q x (q x v) of a rotation by a quaternion."""
    turn = np.array([*(math.sin(tilt / 2) * np.array(axis) / math.hypot(*axis)), math.cos(tilt / 2)])
    x, y, z, w = product(turn, np.array([1.0, 0, 0, 0]))  # first it looks down
    transform = TRANSFORM()
    transform.rotation.x, transform.rotation.y, transform.rotation.z, transform.rotation.w = map(float, (x, y, z, w))
    transform.translation.x, transform.translation.y, transform.translation.z = shift
    info = INFO(p=[300.0, 0.0, 2.0, 0.0, 0.0, 400.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], height=3, width=5)
    camera = modules.messages.camera_of(info, transform, "info")
    points = camera.points(np.full((3, 5), 1.5))
    q = np.array([x, y, z])
    for row, column in ((0, 0), (2, 4)):
        v = np.array([(column - 2) / 300, (row - 1) / 400, 1]) * 1.5
        ours = v + 2 * w * np.cross(q, v) + 2 * np.cross(q, np.cross(q, v)) + shift
        assert points[row, column] == pytest.approx(ours, abs=1e-9)


@given(st.floats(-400, 400), st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1))
def test_poses_are_turned_about_z(modules, yaw, x, y, bottom, high):
    """The corner of a box, by the rotation of a vector by a quaternion about z: x' = (w^2 - z^2) x - 2 w z y, ..."""
    view = modules.messages.View(None, None, "frame", TIME(sec=3))
    box = modules.messages.box_message(Box(x, y, 0.2, 0.1, bottom + high, yaw, 0.004), bottom, view)
    ros.written(box)
    at, turn, size = box.pose.pose.position, box.pose.pose.orientation, box.size
    assert (box.pose.header.frame_id, box.pose.header.stamp, box.edge_error) == ("frame", TIME(sec=3), 0.004)
    assert (turn.x, turn.y, turn.w**2 + turn.z**2) == pytest.approx((0, 0, 1))
    cos, sin = turn.w**2 - turn.z**2, 2 * turn.w * turn.z
    corner = at.x + cos * size.x / 2 - sin * size.y / 2, at.y + sin * size.x / 2 + cos * size.y / 2
    angle = math.radians(yaw) + math.atan2(0.05, 0.1)
    assert corner == pytest.approx((x + 0.05**0.5 / 2 * math.cos(angle), y + 0.05**0.5 / 2 * math.sin(angle)))
    assert (at.z - size.z / 2, at.z + size.z / 2) == pytest.approx((bottom, bottom + high), abs=1e-9)


def product(a, b):
    """Return the product of two quaternions (x, y, z, w): first b turns, then a."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*vector, a[3] * b[3] - a[:3] @ b[:3]])
