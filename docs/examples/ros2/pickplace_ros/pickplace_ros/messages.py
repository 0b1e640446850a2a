"""Between the messages of ROS and the types of pickplace. Metres and radians in messages, as REP 103 says."""

import math
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, Vector3
from pickplace_interfaces import msg
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image

from pickplace import Box, Camera, DepthMapError, Plan
from pickplace.common.validate import refuse_if

#: Type of a pixel, and metres of its unit, by the encoding of a depth image (REP 118).
ENCODINGS = {"16UC1": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}


@dataclass(frozen=True)
class View:
    """A depth image, its camera in a frame, and when it was taken."""

    camera: Camera
    depth: np.ndarray  # [rows, columns], m; 0 or not finite where nothing was measured
    frame: str
    stamp: Time


def depth_of(image: Image, topic: str) -> np.ndarray:
    """Return a depth image in metres, ``[rows, columns]``, float64.

    Raises:
        DepthMapError: for another encoding, or data that do not fill the image.
    """
    refuse_if(
        image.encoding not in ENCODINGS,
        f"{topic}: encoding={image.encoding!r}; expected {' or '.join(ENCODINGS)}.",
        DepthMapError,
    )
    kind, unit = ENCODINGS[image.encoding]
    pixel = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    refuse_if(
        len(image.data) != image.height * image.step or image.step < image.width * pixel.itemsize,
        f"{topic}: {len(image.data)} bytes with step={image.step}; expected {image.height} rows of {image.width} "
        f"pixels of {pixel.itemsize} bytes.",
        DepthMapError,
    )
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)  # a row may be padded
    values = np.ascontiguousarray(rows[:, : image.width * pixel.itemsize]).view(pixel)
    return values.astype(np.float64) * unit


def camera_of(info: CameraInfo, transform: Transform, topic: str) -> Camera:
    """Return the camera of a rectified image.

    Args:
        info: of the image.
        transform: from the camera's optical frame (x right, y down, z forward) to that of the bin or tote.
        topic: of the camera info.

    Raises:
        ValueError: for an image that is a part of the sensor's, a camera without calibration, or a camera that does
            not look down.
    """
    region = info.roi
    refuse_if(
        max(info.binning_x, info.binning_y) > 1 or region.x_offset or region.y_offset,
        f"{topic}: binning {info.binning_x} x {info.binning_y}, region at {region.x_offset}, {region.y_offset}; "
        "expected the calibration of the image itself.",
    )
    refuse_if(
        not (info.p[0] > 0 and info.p[5] > 0),
        f"{topic}: P has the focal lengths {info.p[0]:g} and {info.p[5]:g}; expected those of a calibrated camera.",
    )
    turn, shift = transform.rotation, transform.translation
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    pose[:3, 3] = shift.x, shift.y, shift.z
    # P = [fx 0 cx .; 0 fy cy .; 0 0 1 .], row by row.
    shape = info.height, info.width
    return Camera(fx=info.p[0], fy=info.p[5], cx=info.p[2], cy=info.p[6], pose=pose, shape=shape)


def stamped(center, yaw: float, view: View) -> PoseStamped:
    """Return a pose, z up and turned by a yaw in degrees, in the frame of a view and at its time."""
    message = PoseStamped(pose=Pose(position=Point(x=float(center[0]), y=float(center[1]), z=float(center[2]))))
    half = math.radians(yaw) / 2
    message.pose.orientation = Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
    message.header.frame_id, message.header.stamp = view.frame, view.stamp
    return message


def box_message(box: Box, bottom: float, view: View) -> msg.Box:
    """Return a box whose underside is at a height above the floor."""
    return msg.Box(
        pose=stamped((box.x, box.y, (bottom + box.h) / 2), box.yaw, view),
        size=Vector3(x=float(box.w), y=float(box.d), z=float(box.h - bottom)),
        edge_error=float(box.edge_error),
    )


def plan_message(plan: Plan, over_bin: View, over_tote: View, tote_cells: tuple[int, int]) -> msg.Plan:
    """Return the message of a plan from two views, for a tote of so many cells along x and y.

    It has all of the plan but ``item``, the whole cells that the policy sees, and ``alternatives``.
    """
    message = msg.Plan(
        status=plan.status,
        item_number=-1 if plan.item_number is None else plan.item_number,
        action=-1 if plan.action is None else plan.action,
        occupancy_before=float(plan.occupancy_before),
        occupancy_after=float(plan.occupancy_after),
        tote_cells=list(tote_cells),
        tote_bearing=[cell for row in plan.tote_bearing or () for cell in row],
        reasons=[msg.Reason(name=name, count=count) for name, count in (plan.reasons or {}).items()],
        hints=list(plan.hints),
        warnings=list(plan.warnings),
    )
    if plan.box is not None:
        message.box = box_message(plan.box, 0.0, over_bin)
    if plan.status == msg.Plan.OK:
        message.pick = stamped(plan.pick.center, plan.pick.yaw, over_bin)
        message.place = stamped(plan.place.center, plan.place.yaw, over_tote)
        message.rotation = math.radians(plan.rotation_degrees)
        message.drop_height = float(plan.drop_height)
        message.placed = box_message(plan.placed, plan.drop_height, over_tote)
    return message
