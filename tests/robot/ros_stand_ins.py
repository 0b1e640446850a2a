"""Stand-ins for ROS: messages made from their real definitions, and the parts of rclpy and tf2 that the node uses.

Each message that the node sends is written as CDR and read back, by ``rosbags``. Fields take the types that the Python
messages of ROS take.
"""

import array
import importlib
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import Nodetype

ROS = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ros2"
INTERFACES = ROS / "pickplace_interfaces"
PACKAGE = ROS / "pickplace_ros"
MODULES = [f"pickplace_ros.{name}" for name in ("parameters", "record", "messages", "node")]
ACTION_PARTS = ("Goal", "Result", "Feedback")


def read_definitions():
    """Return a store with the messages of ROS and ours, parts of actions and services as messages of their own."""
    store, found = get_typestore(Stores.ROS2_JAZZY), {}
    texts = {path.stem: path.read_text() for path in INTERFACES.glob("msg/*.msg")}
    for path in INTERFACES.glob("action/*.action"):
        parts = path.read_text().split("---\n")
        texts |= {f"{path.stem}_{part}": text for part, text in zip(ACTION_PARTS, parts, strict=True)}
    for name, text in texts.items():
        found |= get_types_from_msg(text, f"pickplace_interfaces/msg/{name}")
    found |= get_types_from_msg("", "std_srvs/msg/Trigger_Request")
    found |= get_types_from_msg("bool success\nstring message", "std_srvs/msg/Trigger_Response")
    store.register(found)
    return store


STORE = read_definitions()


class Message:
    """A message: its fields begin with zeros, and refuse what the messages of ROS refuse."""

    def __init__(self, **fields):
        for name, kind in self.KINDS.items():
            object.__setattr__(self, name, zero(kind))
        for name, value in fields.items():
            setattr(self, name, value)

    def __setattr__(self, name, value):
        assert name in self.KINDS, f"{self.NAME} has no field {name}"
        assert fits(self.KINDS[name], value), f"{self.NAME}.{name}: {type(value).__name__} {value!r}"[:200]
        object.__setattr__(self, name, value)

    def __eq__(self, other):
        return plain(self) == plain(other)


_classes: dict[str, type] = {}


def message_class(name: str) -> type:
    """Return the class of a message, such as ``"sensor_msgs/msg/Image"``."""
    if name not in _classes:
        constants, fields = STORE.fielddefs[name]
        known = {key: value for key, _, value in constants}
        _classes[name] = type(name.rpartition("/")[2], (Message,), {"NAME": name, "KINDS": dict(fields), **known})
    return _classes[name]


def zero(kind):
    """Return the value with which a field begins."""
    form, content = kind
    if form == Nodetype.BASE:
        return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(content[0], 0)
    if form == Nodetype.NAME:
        return message_class(content)()
    return [zero(content[0]) for _ in range(content[1])] if form == Nodetype.ARRAY else []


def fits(kind, value) -> bool:
    """Return whether a value has the type of a field, as the setters of ROS check it."""
    form, content = kind
    if form == Nodetype.NAME:
        return isinstance(value, message_class(content))
    if form == Nodetype.BASE:
        name = content[0]
        if name in ("string", "bool"):
            return isinstance(value, str if name == "string" else bool)
        if name.startswith("float"):
            return isinstance(value, float)
        return isinstance(value, int) and np.iinfo(name).min <= value <= np.iinfo(name).max
    element, length = content
    long_enough = len(value) == length if form == Nodetype.ARRAY else not length or len(value) <= length
    is_bytes = isinstance(value, array.array) and value.typecode == "B" and element[1][0] == "uint8"
    return long_enough and (is_bytes or isinstance(value, list) and all(fits(element, each) for each in value))


def plain(value):
    """Return a message, of ours or of rosbags, as plain values."""
    if isinstance(value, (list, np.ndarray, array.array)):
        return [plain(each) for each in value]
    name = getattr(value, "NAME", None) or getattr(value, "__msgtype__", None)
    return value if name is None else {key: plain(getattr(value, key)) for key, _ in STORE.fielddefs[name][1]}


def written(message: Message):
    """Return a message as rosbags writes it, after it was written as CDR and read back."""

    def convert(value):
        if isinstance(value, Message):
            fields = {name: array_of(value.KINDS[name], getattr(value, name)) for name in value.KINDS}
            return STORE.types[value.NAME](**fields)
        return value

    def array_of(kind, value):
        if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and kind[1][0][0] == Nodetype.BASE:
            name = kind[1][0][1][0]
            return value if name == "string" else np.array(value, dtype=name)
        return [convert(each) for each in value] if isinstance(value, list) else convert(value)

    back = STORE.deserialize_cdr(STORE.serialize_cdr(convert(message), message.NAME), message.NAME)
    assert plain(back) == plain(message)
    return back


class ParameterError(Exception):
    """Stands in for ``rclpy.exceptions.ParameterException``."""


class TransformError(Exception):
    """Stands in for ``tf2_ros.TransformException``."""


class Response(Enum):
    """Stands in for ``GoalResponse`` and ``CancelResponse``."""

    REJECT = 1
    ACCEPT = 2


class Node:
    """Stands in for ``rclpy.node.Node``: parameters as given, messages kept, a clock that a test sets."""

    given: dict = {}  # the parameters of the next node
    nodes: list = []  # all that were made

    def __init__(self, name):
        self.node_name, self.nanoseconds, self.warnings = name, 10**18, []
        self.descriptors, self.subscribers, self.services, self.sent = {}, {}, {}, []
        Node.nodes.append(self)

    def declare_parameter(self, name, default, descriptor):
        value, self.descriptors[name] = self.given.get(name, default), descriptor
        if type(value) is not type(default):
            raise ParameterError(f"Wrong parameter type, parameter {name!r} is {type(value).__name__}.")
        for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
            if not limits.from_value <= value <= limits.to_value:
                raise ParameterError(f"Parameter {name} out of range.")
        written(descriptor)
        return SimpleNamespace(value=array.array("q", value) if isinstance(value, list) else value)

    def create_subscription(self, kind, topic, callback, quality):
        def take(message):
            assert isinstance(message, kind)
            written(message)
            callback(message)

        self.subscribers[topic] = take

    def create_publisher(self, kind, topic, depth):
        def publish(message):
            assert isinstance(message, kind)
            written(message)
            self.sent.append((topic, message))

        return SimpleNamespace(publish=publish)

    def create_service(self, kind, name, callback):
        def call():
            answer = callback(kind.Request(), kind.Response())
            written(answer)
            return answer

        self.services[name] = call

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.nanoseconds))

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


class ActionServer:
    """Stands in for ``rclpy.action.ActionServer``; :meth:`send` is what a client does."""

    def __init__(self, node, kind, name, execute, *, goal_callback, cancel_callback, callback_group):
        assert (name, callback_group) == ("~/compute_plan", "reentrant")
        self.kind, self.execute, self.accept, self.cancel = kind, execute, goal_callback, cancel_callback

    def send(self, **deadline) -> "Goal | None":
        """Send a goal, with a deadline of so many ``sec`` and ``nanosec``; return it, or None if it was rejected."""
        request = self.kind.Goal(deadline=message_class("builtin_interfaces/msg/Duration")(**deadline))
        written(request)
        return Goal(self, request) if self.accept(request) is Response.ACCEPT else None


class Goal:
    """Stands in for ``ServerGoalHandle``, with its states, and for the client's handle."""

    ENDS = {"succeed": ("executing", "canceling"), "abort": ("executing", "canceling"), "canceled": ("canceling",)}

    def __init__(self, server, request):
        self.server, self.request, self.state, self.feedback, self.result = server, request, "executing", [], None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        self.result = self.server.execute(self)

    @property
    def is_cancel_requested(self):
        return self.state == "canceling"

    def publish_feedback(self, message):
        assert isinstance(message, self.server.kind.Feedback)
        written(message)
        self.feedback.append((message.stage, message.message))

    def _end(self, how):
        assert self.state in self.ENDS[how], f"{how} from {self.state}"
        self.state = how

    def succeed(self):
        self._end("succeed")

    def abort(self):
        self._end("abort")

    def canceled(self):
        self._end("canceled")

    def cancel(self):
        """Cancel it, as a client does."""
        assert self.server.cancel(self) is Response.ACCEPT
        self.state = "canceling"

    def wait(self):
        """Return the result, and check it."""
        self.thread.join(60)
        assert isinstance(self.result, self.server.kind.Result)
        written(self.result)
        return self.result


class Buffer:
    """Stands in for ``tf2_ros.Buffer``: transforms by target and source frame."""

    def __init__(self):
        self.known, self.asked = {}, []

    def lookup_transform(self, target, source, time):
        self.asked.append((target, source, time.nanoseconds))
        if (target, source) not in self.known:
            raise TransformError(f'"{source}" passed to lookupTransform argument source_frame does not exist.')
        return message_class("geometry_msgs/msg/TransformStamped")(transform=self.known[target, source])


class Time:
    """Stands in for ``rclpy.time.Time``."""

    @staticmethod
    def from_msg(stamp):
        return SimpleNamespace(nanoseconds=stamp.sec * 10**9 + stamp.nanosec)


class Executor:
    """Stands in for ``MultiThreadedExecutor``: spins until Ctrl-C, which comes at once."""

    def __init__(self, num_threads):
        assert num_threads > 1

    def add_node(self, node):
        assert isinstance(node, Node)

    def spin(self):
        raise KeyboardInterrupt


def packages() -> dict[str, ModuleType]:
    """Return the modules that the node imports, by name."""
    plain_names = ("builtin_interfaces", "geometry_msgs", "rcl_interfaces", "sensor_msgs", "pickplace_interfaces")
    contents = {f"{package}.msg": {} for package in plain_names}
    for name in STORE.fielddefs:
        package, _, short = name.split("/")
        if package in plain_names:
            contents[f"{package}.msg"][short] = message_class(name)
    own = contents["pickplace_interfaces.msg"]
    action = SimpleNamespace(**{part: own[f"ComputePlan_{part}"] for part in ACTION_PARTS})
    trigger = {part: message_class(f"std_srvs/msg/Trigger_{part}") for part in ("Request", "Response")}
    contents |= {
        "pickplace_interfaces.action": {"ComputePlan": action},
        "std_srvs.srv": {"Trigger": SimpleNamespace(**trigger)},
        "rclpy.action": {"ActionServer": ActionServer, "GoalResponse": Response, "CancelResponse": Response},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": lambda: "reentrant"},
        "rclpy.exceptions": {"ParameterException": ParameterError},
        "rclpy.executors": {"ExternalShutdownException": TransformError, "MultiThreadedExecutor": Executor},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": object()},
        "rclpy.time": {"Time": Time},
        "rclpy": {"state": [], "init": lambda: None, "try_shutdown": lambda: sys.modules["rclpy"].state.append("down")},
        "tf2_ros": {"Buffer": Buffer, "TransformException": TransformError, "TransformListener": lambda *_: None},
    }
    modules = {name: ModuleType(name) for name in (*contents, *(name.partition(".")[0] for name in contents))}
    for name, content in contents.items():
        vars(modules[name]).update(content)
        if "." in name:
            setattr(modules[name.partition(".")[0]], name.partition(".")[2], modules[name])
    return modules


@contextmanager
def installed() -> Iterator[SimpleNamespace]:
    """Yield the modules of the node's package, by name; where ROS is, there are stand-ins."""
    with pytest.MonkeyPatch.context() as patch:
        for name, module in packages().items():
            patch.setitem(sys.modules, name, module)
        patch.syspath_prepend(str(PACKAGE))
        yield SimpleNamespace(**{name.rpartition(".")[2]: importlib.import_module(name) for name in MODULES})
        for name in ("pickplace_ros", *MODULES):
            del sys.modules[name]
