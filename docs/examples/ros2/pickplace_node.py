"""A ROS 2 node: depth images in, poses for a pick and a place out. Not tested with ROS; see README.md."""

import math

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from pickplace import Camera, DepthMapError, Planner, Scene

#: Type of a pixel, and metres of its unit, by the encoding of a depth image (REP 118).
ENCODINGS = {"16UC1": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}


class PickPlaceNode(Node):
    """Plans when ``~/plan`` is called, from the newest images.

    Topics read: ``bin/depth``, ``tote/depth`` (sensor_msgs/Image, rectified), ``bin/camera_info``,
    ``tote/camera_info`` (sensor_msgs/CameraInfo). Topics written: ``~/pick`` in the frame ``bin``, ``~/place`` in the
    frame ``tote`` (geometry_msgs/PoseStamped). Services (std_srvs/Trigger): ``~/plan``; ``~/placed`` when the robot has
    done what the plan says; ``~/new_tote`` when the tote was changed for an empty one.
    """

    def __init__(self):
        super().__init__("pickplace")
        number = self.declare_parameter
        checkpoint = number("checkpoint", "pretrained/mixed").value
        self.cell_size = number("cell_size", 0.05).value  # side of a cell, m
        self.accuracy = number("accuracy", 0.003).value  # greatest error of a height, m
        self.clearance = number("clearance", 0.005).value  # m
        self.longest_age = number("longest_age", 1.0).value  # of an image that is planned from, s
        tote_size = tuple(number("tote_size", [0, 0, 0]).value)  # cells; zeros: as trained
        self.planner = Planner.load(checkpoint, **({"tote_size": tote_size} if any(tote_size) else {}))
        cell = self.planner.cell
        # [4, 4] row by row: the camera's optical frame in the frame of the bin, and of the tote.
        # Here: 1.2 m above the middle.
        self.poses = {}
        for place, (wide, deep, _) in (("bin", cell.bin_size), ("tote", cell.tote_size)):
            above = np.diag((1.0, -1.0, -1.0, 1.0))
            above[:3, 3] = wide * self.cell_size / 2, deep * self.cell_size / 2, 1.2
            self.poses[place] = number(f"{place}_camera_pose", above.ravel().tolist()).value
        self.images, self.infos = {}, {}
        for place in self.poses:
            for kind, topic, kept in ((Image, "depth", self.images), (CameraInfo, "camera_info", self.infos)):

                def keep(message, place=place, kept=kept):
                    kept[place] = message

                self.create_subscription(kind, f"{place}/{topic}", keep, qos_profile_sensor_data)
        self.publishers_of = {frame: self.create_publisher(PoseStamped, f"~/{name}", 1)
                              for frame, name in (("bin", "pick"), ("tote", "place"))}  # fmt: skip
        # Where the tote bears weight, what it holds, and the plan that the robot carries out.
        self.bearing, self.placed_boxes, self.open = None, [], None
        for name in ("plan", "placed", "new_tote"):
            self.create_service(Trigger, f"~/{name}", getattr(self, name))

    def plan(self, _, response):
        """Plan, publish both poses, and answer with the status; without a plan nothing is published."""
        self.open = None
        try:
            depth = {place: self.depth_of(place) for place in self.poses}
            cameras = {place: self.camera_of(place) for place in self.poses}
            scene = Scene.from_images(
                self.planner.cell, *((cameras[place], depth[place]) for place in ("bin", "tote")), self.cell_size,
                self.accuracy, clearance=self.clearance, tote_bearing=self.bearing, placed=self.placed_boxes,
            )  # fmt: skip
            plan = self.planner.plan(scene)
        except (DepthMapError, ValueError) as error:
            response.success, response.message = False, str(error)
            return response
        response.success, response.message = plan.status == "ok", plan.status
        if plan.status == "ok":
            self.open = plan
            self.publish("bin", plan.pick)
            self.publish("tote", plan.place)
        return response

    def placed(self, _, response):
        """Note that the tote holds what the last plan put there."""
        response.success = self.open is not None
        response.message = "" if response.success else "no plan is open"
        if response.success:
            self.placed_boxes.append(self.open.placed)
            self.bearing, self.open = self.open.tote_bearing, None
        return response

    def new_tote(self, _, response):
        """Forget the tote."""
        self.bearing, self.placed_boxes, self.open = None, [], None
        response.success = True
        return response

    def depth_of(self, place: str) -> np.ndarray:
        """Return the newest depth image of the bin or the tote, in metres, 0 or NaN where nothing was measured."""
        image = self.images.get(place)
        if image is None:
            raise ValueError(f"{place}/depth: no image yet.")
        stamp = image.header.stamp
        age = self.get_clock().now().nanoseconds / 1e9 - (stamp.sec + stamp.nanosec / 1e9)
        if age > self.longest_age:
            raise ValueError(f"{place}/depth: the image is {age:.1f} s old; expected at most {self.longest_age:g} s.")
        if image.encoding not in ENCODINGS:
            raise ValueError(f"{place}/depth: encoding {image.encoding}; expected {' or '.join(ENCODINGS)}.")
        kind, unit = ENCODINGS[image.encoding]
        pixel = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
        rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)  # a row may be padded
        values = np.ascontiguousarray(rows[:, : image.width * pixel.itemsize]).view(pixel)
        return values.astype(np.float64) * unit

    def camera_of(self, place: str) -> Camera:
        """Return the camera above the bin or the tote."""
        info = self.infos.get(place)
        if info is None:
            raise ValueError(f"{place}/camera_info: no message yet.")
        pose = np.array(self.poses[place]).reshape(4, 4)
        # Of the rectified image: P = [fx 0 cx .; 0 fy cy .; 0 0 1 .].
        shape = info.height, info.width
        return Camera(fx=info.p[0], fy=info.p[5], cx=info.p[2], cy=info.p[6], pose=pose, shape=shape)

    def publish(self, frame: str, pose) -> None:
        """Publish the centre of the suction face, z up, turned by its yaw."""
        message = PoseStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = frame
        at, turn = message.pose.position, message.pose.orientation
        at.x, at.y, at.z = pose.center
        turn.z, turn.w = math.sin(math.radians(pose.yaw) / 2), math.cos(math.radians(pose.yaw) / 2)
        self.publishers_of[frame].publish(message)


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = PickPlaceNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
