"""The node: depth images in, plans for a pick and a place out. Not tested with ROS; see the README."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import rclpy
from geometry_msgs.msg import PoseStamped
from pickplace_interfaces.action import ComputePlan
from pickplace_interfaces.msg import Plan as PlanMessage
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformException, TransformListener

from pickplace import DepthMapError, EmptyBinError, Plan, Scene
from pickplace.common.errors import sentence
from pickplace.common.validate import number, refuse_if
from pickplace.serve.deadline import Deadline
from pickplace.serve.request import MAX_DEADLINE
from pickplace_ros.messages import View, camera_of, depth_of, plan_message
from pickplace_ros.parameters import LEAST_DEADLINE, declare, load
from pickplace_ros.record import Record

PLACES = ("bin", "tote")
POLL_SECONDS = 0.02  # between two looks at what has arrived, and at whether the goal was cancelled
THREADS = 4  # one plans; the others take images, transforms, cancellations and reports

Found = TypeVar("Found")


class NotReady(Exception):
    """Something that the node waits for is not there yet; the message is one sentence."""


class Canceled(Exception):
    """The client has cancelled the goal."""


class PickPlaceNode(Node):
    """Computes a plan for each goal of ``~/compute_plan``, from images that are taken after the goal arrived.

    The README lists topics, services, the action and parameters. One goal is worked on at a time; meanwhile others are
    rejected, and reports are refused.
    """

    def __init__(self):
        super().__init__("pickplace")
        self.settings = declare(self)
        self.planner = load(self.settings)
        self.record, self.is_busy, self.lock = Record(), False, threading.Lock()
        self.images: dict[str, Image] = {}
        self.infos: dict[str, CameraInfo] = {}
        for place in PLACES:
            for kind, topic, kept in ((Image, "depth", self.images), (CameraInfo, "camera_info", self.infos)):
                keep = partial(kept.__setitem__, place)
                self.create_subscription(kind, f"{place}/{topic}", keep, qos_profile_sensor_data)
        self.frames = Buffer()
        self.listener = TransformListener(self.frames, self)
        self.plan_publisher = self.create_publisher(PlanMessage, "~/plan", 1)
        self.pose_publishers = {name: self.create_publisher(PoseStamped, f"~/{name}", 1) for name in ("pick", "place")}
        for event in Record.EVENTS:
            self.create_service(Trigger, f"~/{event}", partial(self.report, event))
        self.action_server = ActionServer(
            self, ComputePlan, "~/compute_plan", self.execute,
            goal_callback=self.accept, cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),  # a goal is cancelled while it is executed
        )  # fmt: skip

    def report(self, event: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Note what the robot has done, or what has become of bin and tote."""
        try:
            with self.lock:
                refuse_if(self.is_busy, "a plan is being computed; expected a report before the goal, or after it.")
                getattr(self.record, event)()
            response.success = True
        except ValueError as error:
            response.success, response.message = False, str(error)
        return response

    def accept(self, _: ComputePlan.Goal) -> GoalResponse:
        """Accept a goal, unless one is worked on."""
        with self.lock:
            if self.is_busy:
                self.get_logger().warning("goal rejected: a plan is being computed; expected one goal at a time.")
                return GoalResponse.REJECT
            self.is_busy = True
            return GoalResponse.ACCEPT

    def execute(self, goal) -> ComputePlan.Result:
        """Work on a goal: the state of the goal says whether there is a plan, and the result's outcome why not."""
        result = ComputePlan.Result()
        try:
            result.plan = self.compute(goal)
            result.outcome = ComputePlan.Result.PLANNED
            goal.succeed()
        except Canceled as error:
            result.outcome, result.message = ComputePlan.Result.CANCELED, str(error)
            goal.canceled()
        except (NotReady, TimeoutError, ValueError, FloatingPointError) as error:
            outcomes = {
                NotReady: ComputePlan.Result.NOT_READY, TimeoutError: ComputePlan.Result.TIMEOUT,
                EmptyBinError: ComputePlan.Result.EMPTY, DepthMapError: ComputePlan.Result.REFUSED,
            }  # fmt: skip
            kinds = (outcome for kind, outcome in outcomes.items() if isinstance(error, kind))
            result.outcome = next(kinds, ComputePlan.Result.FAILED)
            result.message = str(error)
            self.get_logger().warning(result.message)
            goal.abort()
        finally:
            self.is_busy = False
        return result

    def compute(self, goal) -> PlanMessage:
        """Wait for new images, plan, publish the plan, and return it.

        Raises:
            Canceled: if the client cancels the goal.
            NotReady: if something is missing until the deadline.
            TimeoutError: if there is no plan until then.
            DepthMapError: for images that cannot be planned with.
            ValueError: for a deadline or a camera that cannot be used.
            FloatingPointError: for weights whose scores are not finite.
        """
        self.record.open = None
        arrival, given = self.get_clock().now().nanoseconds, goal.request.deadline
        seconds = given.sec + given.nanosec / 1e9 or self.settings["deadline"]
        deadline = Deadline(number("deadline", seconds, LEAST_DEADLINE, MAX_DEADLINE, "seconds"))
        views = [self.view(place, arrival, partial(self.wait, goal, deadline)) for place in PLACES]
        goal.publish_feedback(ComputePlan.Feedback(stage=ComputePlan.Feedback.PLANNING))
        with cancelling(goal, deadline):
            plan = deadline.run(partial(self.plan, *views))
        message = plan_message(plan, *views, self.planner.cell.tote_size[:2])
        self.plan_publisher.publish(message)
        if plan.status == PlanMessage.OK:
            self.record.open = plan
            self.pose_publishers["pick"].publish(message.pick)
            self.pose_publishers["place"].publish(message.place)
        return message

    def wait(self, goal, deadline: Deadline, find: Callable[[], Found]) -> Found:
        """Return what a function returns as soon as it does not raise :class:`NotReady`; tell the client meanwhile.

        Raises:
            NotReady: of the function, at the deadline.
            Canceled: if the client cancels the goal.
        """
        last_message = None
        while True:
            if goal.is_cancel_requested:
                raise Canceled(f"cancelled: {last_message or 'the goal'}")
            try:
                return find()
            except NotReady as error:
                if not deadline.left():
                    raise
                if str(error) != last_message:
                    last_message = str(error)
                    goal.publish_feedback(
                        ComputePlan.Feedback(stage=ComputePlan.Feedback.WAITING, message=last_message)
                    )
            time.sleep(POLL_SECONDS)

    def view(self, place: str, arrival: int, wait: Callable[[Callable[[], Found]], Found]) -> View:
        """Return the first image of the bin or tote that is new enough, with its camera.

        Args:
            place: ``"bin"`` or ``"tote"``.
            arrival: of the goal, in nanoseconds.
            wait: returns what a function finds, see :meth:`wait`.
        """
        image = wait(partial(self.new_image, place, arrival))
        info = wait(partial(self.camera_info, place))
        frame = self.settings[f"{place}_frame"]
        transform = wait(partial(self.transform, frame, image.header))
        camera = camera_of(info, transform, f"{place}/camera_info")
        return View(camera, depth_of(image, f"{place}/depth"), frame, image.header.stamp)

    def new_image(self, place: str, arrival: int) -> Image:
        """Return the newest image of a place if it is new enough."""
        image = self.images.get(place)
        refuse_if(image is None, f"{place}/depth: no image yet.", NotReady)
        stamp, longest = image.header.stamp, self.settings["longest_age"]
        age = (arrival - stamp.sec * 10**9 - stamp.nanosec) / 1e9
        refuse_if(
            age > longest,
            f"{place}/depth: the newest image was taken {age:.2f} s before the goal arrived; expected "
            f"longest_age={longest:g} s at most.",
            NotReady,
        )
        return image

    def camera_info(self, place: str) -> CameraInfo:
        """Return the camera info of a place."""
        refuse_if(place not in self.infos, f"{place}/camera_info: no message yet.", NotReady)
        return self.infos[place]

    def transform(self, frame: str, header):
        """Return the transform to a frame from that of an image, at the time of the image."""
        try:
            return self.frames.lookup_transform(frame, header.frame_id, Time.from_msg(header.stamp)).transform
        except TransformException as error:
            message = f"tf: no transform to {frame!r} from {header.frame_id!r} at the image's time: {error}"
            raise NotReady(message) from error

    def plan(self, over_bin: View, over_tote: View) -> Plan:
        """Plan from two views and from what was done before."""
        keys = ("accuracy", "bin_height", "tote_height", "greatest_height", "clearance", "placement_error")
        settings = {key: self.settings[key] for key in keys}
        scene = Scene.from_images(
            self.planner.cell, (over_bin.camera, over_bin.depth), (over_tote.camera, over_tote.depth),
            self.settings["cell_size"], tote_bearing=self.record.bearing, placed=self.record.placed_boxes, **settings,
        )  # fmt: skip
        return self.planner.plan(scene, alternatives=0, exclude=self.record.excluded)


@contextmanager
def cancelling(goal, deadline: Deadline) -> Iterator[None]:
    """End what runs with a deadline when the client cancels the goal.

    Raises:
        Canceled: instead of the ``TimeoutError`` of the deadline, then.
    """
    is_done = threading.Event()

    def watch() -> None:
        while not is_done.wait(POLL_SECONDS):
            if goal.is_cancel_requested:
                deadline.cancel()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    except TimeoutError as error:
        if goal.is_cancel_requested:
            raise Canceled("cancelled while the plan was computed.") from error
        raise
    finally:
        is_done.set()
        watcher.join()


def main() -> None:
    """Run the node until Ctrl-C; a parameter that cannot be used ends it with one sentence."""
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=THREADS)
        executor.add_node(PickPlaceNode())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (OSError, ValueError) as error:
        sys.exit(f"pickplace_node: {sentence(error)}")
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
