"""The ROS package in docs/examples/ros2, without ROS: the node with stand-ins, and the files of both packages."""

import math
import time
from array import array

import numpy as np
import pytest
import ros_stand_ins as ros

SHAPE = (240, 320)
IMAGE, INFO = ros.message_class("sensor_msgs/msg/Image"), ros.message_class("sensor_msgs/msg/CameraInfo")
TRANSFORM = ros.message_class("geometry_msgs/msg/Transform")
JOINT = {"checkpoint": "", "planner": "joint_dbl", "tote_size": [6, 6, 5]}
WAITING, PLANNING = 0, 1


@pytest.fixture(scope="module")
def modules():
    with ros.installed() as found:
        yield found


class Cell:
    """A node with its cameras: two that look down from 1.2 m above the middle of bin and tote."""

    ABOVE = {"bin": (0.125, 0.125), "tote": (0.15, 0.15)}

    def __init__(self, modules, monkeypatch, parameters):
        monkeypatch.setattr(ros.Node, "given", parameters)
        self.node = modules.node.PickPlaceNode()
        self.server, self.record = self.node.action_server, self.node.record
        for place in self.ABOVE:
            self.aim(place)

    def aim(self, place, **changes):
        """Let tf know the camera above a place, and send its info."""
        transform = TRANSFORM()
        transform.rotation.x, transform.rotation.w = 1.0, 0.0  # half a turn about x: it looks down
        (x, y), z = self.ABOVE[place], 1.2
        transform.translation.x, transform.translation.y, transform.translation.z = x, y, z
        frame = self.node.settings[f"{place}_frame"]
        self.node.frames.known[frame, f"{place}_camera_optical_frame"] = transform
        p = [500.0, 0.0, 159.5, 0.0, 0.0, 500.0, 119.5, 0.0, 0.0, 0.0, 1.0, 0.0]
        info = {"p": p, "height": SHAPE[0], "width": SHAPE[1], **changes}
        self.node.subscribers[f"{place}/camera_info"](INFO(**info))

    def see(self, items=((100, 120, 140, 160),), at=0.0, tote=None, **changes):
        """Send images of a bin with items, and of a tote, taken so many seconds after now."""
        images = {"bin": np.full(SHAPE, 1150, np.uint16), "tote": np.full(SHAPE, 950, np.uint16)}
        images["bin"][65:175, 105:215], images["bin"][68:172, 108:212] = 0, 1200  # walls and floor
        images["tote"][41:199, 81:239], images["tote"][58:182, 98:222] = 0, 1200
        for top, bottom, left, right in items:
            images["bin"][top:bottom, left:right] = 1140  # of 60 mm
        for place, image in images.items():
            self.show(place, image if place == "bin" or tote is None else tote, at, **changes)

    def show(self, place, image, at=0.0, **changes):
        """Send an image of a place."""
        message = IMAGE(
            height=image.shape[0], width=image.shape[1], step=2 * image.shape[1], encoding="16UC1",
            data=array("B", image.astype("<u2").tobytes()),
        )  # fmt: skip
        nanoseconds = self.node.nanoseconds + int(at * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        message.header.frame_id = f"{place}_camera_optical_frame"
        for name, value in changes.items():
            setattr(message, name, value)
        self.node.subscribers[f"{place}/depth"](message)

    def plan(self, **deadline):
        """Send a goal, and return the result."""
        return self.server.send(**deadline).wait()

    def call(self, name):
        """Call a service; return whether it did it, and what it says."""
        answer = self.node.services[f"~/{name}"]()
        return answer.success, answer.message

    def until(self, condition):
        """Wait for a condition, a minute at most."""
        end = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.005)


@pytest.fixture
def make(modules, monkeypatch):
    """Return a function that makes a cell with parameters of its node."""
    return lambda **parameters: Cell(modules, monkeypatch, JOINT | parameters)


@pytest.mark.parametrize("checkpoint", ["pretrained/r4", "pretrained/unmasked"])
def test_a_goal_is_planned_and_placed(make, checkpoint):
    """Also with a rule for stability that has no map of what bears weight."""
    cell = make(checkpoint=checkpoint, planner="", tote_size=[0, 0, 0])
    node, record = cell.node, cell.record
    assert cell.call("placed") == (False, "no plan is open; expected one report after each plan that is ok.")
    cell.see()
    goal = cell.server.send()
    result = goal.wait()
    plan = result.plan
    assert (goal.state, result.outcome, result.message, plan.status) == ("succeed", result.PLANNED, "", plan.OK)
    assert goal.feedback == [(PLANNING, "")]
    assert (plan.pick.header.frame_id, plan.place.header.frame_id) == ("bin", "tote")
    assert plan.pick.header.stamp.sec == 10**9
    # The item's middle is 10 pixels left of and above that of the image; image rows run against y.
    off, at = 10 / 500 * 1.14, plan.box.pose.pose.position
    assert (at.x, at.y, at.z) == pytest.approx((0.125 - off, 0.125 + off, 0.03), abs=0.003)
    assert (plan.box.size.x, plan.box.size.y, plan.box.size.z) == pytest.approx((0.046, 0.046, 0.06), abs=0.006)
    assert plan.pick.pose.position.z == pytest.approx(0.06, abs=0.01)
    found = record.open
    assert (plan.action, plan.item_number, plan.drop_height) == (found.action, 0, found.drop_height)
    assert plan.rotation == pytest.approx(math.radians(found.rotation_degrees))
    placed = plan.placed.pose.pose.position
    assert (placed.x, placed.y, placed.z) == pytest.approx(
        (found.placed.x, found.placed.y, found.drop_height + plan.box.size.z / 2)
    )
    assert plan.placed.size.z == pytest.approx(plan.box.size.z)
    marks = node.planner.cell.support.marks_bearing
    assert plan.tote_cells == [6, 6] and plan.tote_bearing == (sum(found.tote_bearing, []) if marks else [])
    assert [topic for topic, _ in node.sent] == ["~/plan", "~/pick", "~/place"]
    assert [sent for _, sent in node.sent] == [plan, plan.pick, plan.place]
    assert cell.call("placed") == (True, "") and not cell.call("placed")[0]
    assert record.placed_boxes == [found.placed] and record.bearing == found.tote_bearing
    assert (record.bearing is not None) == marks
    assert cell.plan().plan.status == plan.OK and cell.call("new_tote") == (True, "")
    assert (record.bearing, record.placed_boxes, record.open) == (None, [], None) and not cell.call("placed")[0]


def test_the_planner_is_told_what_was_done_before(make, monkeypatch):
    cell, asked = make(accuracy=0.004, clearance=0.006, placement_error=0.002, tote_height=0.24), []
    plan_for = cell.node.planner.plan

    def plan(scene, **given):
        asked.append((scene, [*given["exclude"]]))
        return plan_for(scene, **given)

    monkeypatch.setattr(cell.node.planner, "plan", plan)
    cell.see()
    first = cell.plan().plan
    assert cell.call("pick_failed") == (True, "") and not cell.call("pick_failed")[0]
    second = cell.plan().plan
    centres = [(each.pick.pose.position.x, each.pick.pose.position.y) for each in (first, second)]
    assert second.status == second.OK and math.dist(*centres) > 0.0249  # half a cell
    assert [excluded for _, excluded in asked] == [[], cell.record.excluded]
    assert cell.call("bin_changed") == (True, "") and cell.record.excluded == []
    third = cell.plan().plan
    assert third.pick == first.pick and cell.call("pick_failed")[0] and cell.record.excluded
    assert cell.plan().plan.status == second.OK and cell.call("placed")[0]
    assert cell.record.excluded == [] and len(cell.record.placed_boxes) == 1
    cell.plan()
    scene = asked[-1][0]
    assert scene.tote_bearing == cell.record.bearing is not None and scene.cell_size == 0.05
    assert (scene.accuracy, scene.clearance, scene.placement_error, scene.tote_height) == (0.004, 0.006, 0.002, 0.24)


def test_what_lies_in_the_tote_as_planned_explains_holes_in_its_image(make):
    """A dark item, of which no pixel has a depth."""
    cell = make(greatest_height=0.07)
    cell.see()
    plan = cell.plan().plan
    assert cell.call("placed")[0]
    dark = np.full(SHAPE, 950, np.uint16)
    dark[41:199, 81:239], dark[58:182, 98:222] = 0, 1200
    at, half = plan.placed.pose.pose.position, plan.placed.size.x / 2
    scale = 500 / (1.2 - 0.06)
    column, row = 159.5 + (at.x - 0.15) * scale, 119.5 - (at.y - 0.15) * scale
    reach = round(half * scale)
    dark[round(row) - reach : round(row) + reach, round(column) - reach : round(column) + reach] = 0
    cell.see(tote=dark)
    second = cell.plan().plan
    assert second.status == "ok" and second.occupancy_before == pytest.approx(0.0125, abs=0.01)
    assert cell.call("new_tote")[0] and cell.plan().plan.occupancy_before > 0.03  # up to the rim
    cell = make(greatest_height=0.04)
    cell.see()
    assert "0.04" in cell.plan().message


def test_a_goal_that_brings_no_plan_closes_the_plan_before(make):
    cell = make()
    cell.see()
    assert cell.plan().plan.status == "ok" and cell.record.open
    cell.see(items=())
    result = cell.plan()
    assert (result.outcome, result.plan.status) == (result.EMPTY, "") and not cell.call("placed")[0]


def test_waits_for_what_is_missing_and_says_so(make):
    cell = make()
    node = cell.node
    infos, known = dict(node.infos), dict(node.frames.known)
    node.infos.clear()
    node.frames.known.clear()
    goal = cell.server.send(sec=50)
    cell.until(lambda: goal.feedback)
    cell.see(at=-0.5)
    cell.until(lambda: len(goal.feedback) == 2)
    cell.see(at=0.25)
    cell.until(lambda: len(goal.feedback) == 3)
    cell.see(at=0.5)  # the frame is that of the image that is used
    node.infos.update(infos)
    cell.until(lambda: len(goal.feedback) == 4)
    node.frames.known.update(known)
    plan = goal.wait().plan
    stamps = [pose.header.stamp.nanosec for pose in (plan.pick, plan.box.pose, plan.place, plan.placed.pose)]
    assert plan.status == "ok" and stamps == [250_000_000, 250_000_000, 500_000_000, 500_000_000]
    assert [stage for stage, _ in goal.feedback] == [WAITING] * 4 + [PLANNING]
    assert [said for _, said in goal.feedback[:4]] == [
        "bin/depth: no image yet.",
        "bin/depth: the newest image was taken 0.50 s before the goal arrived; expected longest_age=0 s at most.",
        "bin/camera_info: no message yet.",
        "tf: no transform to 'bin' from 'bin_camera_optical_frame' at the image's time: "
        '"bin_camera_optical_frame" passed to lookupTransform argument source_frame does not exist.',
    ]
    early, late = (node.nanoseconds + delay for delay in (250_000_000, 500_000_000))
    assert set(node.frames.asked) == {
        ("bin", "bin_camera_optical_frame", early), ("tote", "tote_camera_optical_frame", late)
    }  # fmt: skip


@pytest.mark.parametrize("missing", ["image", "info", "transform"])
def test_the_deadline_ends_the_waiting(make, missing):
    cell = make(deadline=0.05)
    if missing != "image":
        cell.see()
    if missing == "info":
        del cell.node.infos["tote"]
    if missing == "transform":
        del cell.node.frames.known["tote", "tote_camera_optical_frame"]
    goal = cell.server.send()
    result = goal.wait()
    assert (goal.state, result.outcome) == ("abort", result.NOT_READY)
    assert result.message.startswith({"image": "bin/depth", "info": "tote/camera_info", "transform": "tf: no"}[missing])
    assert cell.node.warnings == [result.message]


def test_an_image_from_before_the_goal_is_used_up_to_the_longest_age(make):
    cell = make(longest_age=1.0)
    cell.see(at=-0.99)
    assert cell.plan().outcome == 1
    cell.see(at=-1.01)
    assert cell.plan(nanosec=50_000_000).message.startswith("bin/depth: the newest image was taken 1.01 s before")


def slow(scene, **_):
    """Plan for as long as it may."""
    while True:
        time.sleep(0.001)


def test_the_deadline_ends_the_planning(make, monkeypatch):
    cell = make()
    monkeypatch.setattr(cell.node.planner, "plan", slow)
    cell.see()
    result = cell.plan(nanosec=300_000_000)
    assert result.outcome == result.TIMEOUT and result.message.startswith("no plan within 0.3 s")


@pytest.mark.parametrize(("deadline", "said"), [({"sec": -1}, "-1.0"), ({"sec": 4000}, "4000.0")])
def test_a_deadline_that_cannot_be_used(make, deadline, said):
    result = make().plan(**deadline)
    assert (result.outcome, result.message) == (
        result.FAILED, f"deadline={said}: expected seconds between 0.001 and 3600."
    )  # fmt: skip


@pytest.mark.parametrize("stage", [WAITING, PLANNING])
def test_a_goal_is_cancelled(make, monkeypatch, stage):
    cell = make()
    monkeypatch.setattr(cell.node.planner, "plan", slow)
    if stage == PLANNING:
        cell.see()
    goal = cell.server.send(sec=3000)
    cell.until(lambda: goal.feedback and goal.feedback[-1][0] == stage)
    goal.cancel()
    result = goal.wait()
    assert (goal.state, result.outcome) == ("canceled", result.CANCELED) and result.message.startswith("cancelled")
    assert cell.plan(nanosec=1_000_000).outcome in (result.NOT_READY, result.TIMEOUT)  # the next one is worked on


def test_one_goal_at_a_time_and_no_report_meanwhile(make):
    cell = make()
    goal = cell.server.send(sec=50)
    cell.until(lambda: goal.feedback)
    assert cell.server.send() is None and "one goal at a time" in cell.node.warnings[0]
    for name in cell.record.EVENTS:
        assert cell.call(name) == (False, "a plan is being computed; expected a report before the goal, or after it.")
    cell.see()
    assert goal.wait().outcome == 1 and cell.call("placed")[0] and cell.plan().outcome == 1


@pytest.mark.parametrize(
    ("send", "outcome", "said"),
    [
        (lambda cell: cell.see(encoding="mono16"), "REFUSED", "bin/depth: encoding='mono16'; expected 16UC1 or 32FC1."),
        (lambda cell: cell.see(step=600), "REFUSED", "bin/depth: 153600 bytes with step=600; expected 240 rows of 320"),
        (lambda cell: cell.aim("tote", binning_x=2), "FAILED", "tote/camera_info: binning 2 x 0, region at 0, 0; "),
        (lambda cell: cell.aim("bin", p=[0.0] * 12), "FAILED", "bin/camera_info: P has the focal lengths 0 and 0; "),
        (lambda cell: cell.aim("bin", height=480), "REFUSED", "depth: got shape [240, 320], expected [480, 320]"),
        (
            lambda cell: cell.node.frames.known.update({("bin", "bin_camera_optical_frame"): TRANSFORM()}),
            "FAILED",
            "",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(make, send, outcome, said):
    cell = make()
    cell.see()
    send(cell)
    result = cell.plan()
    assert (result.outcome, result.message[: len(said)]) == (getattr(result, outcome), said) and result.message
