"""The loop of a robot cell: images, plan, motions, grip check. ``robot`` is yours; simulated_robot.py has one."""

from pickplace import DepthMapError, EmptyBinError, Scene

ATTEMPTS = 3  # bad images in a row before somebody is called
MARGIN = 0.03  # between what the robot carries and what it passes over, m


def carry(robot, plan) -> str:
    """Do what a plan says; return where the item went: ``"placed"``, ``"missed"`` or ``"lost"`` on the way."""
    pick, place = robot.base_from_bin @ plan.pick.matrix, robot.base_from_tote @ plan.place.matrix
    above_pick, above_place = pick.copy(), place.copy()
    # The underside of the item hangs plan.pick.center[2] below the tool centre point.
    above_pick[2, 3] = above_place[2, 3] = robot.highest + plan.pick.center[2] + MARGIN
    for pose in (above_pick, pick):
        robot.move(pose)
    robot.suck()
    robot.move(above_pick)
    if not robot.holds_item():
        return "missed"
    robot.move(above_place)  # turns the wrist, too
    if not robot.holds_item():
        return "lost"
    robot.move(place)
    robot.release()
    robot.move(above_place)
    return "placed"


def pack(robot, planner, cell_size: float) -> None:
    """Pack tote after tote until no item arrives."""
    bearing, placed, missed, refused = None, [], [], 0
    while True:
        try:
            views = robot.look()  # (camera, depth image) of the bin and of the tote; the arm is out of both
            scene = Scene.from_images(planner.cell, *views, cell_size, tote_bearing=bearing, placed=placed)
            plan, refused = planner.plan(scene, exclude=missed), 0
        except EmptyBinError:
            missed = []
            if not robot.wait_for_items():
                return
        except DepthMapError as error:
            refused += 1
            if refused % ATTEMPTS == 0:
                robot.call_for_help(str(error))
                bearing, placed, missed = None, [], []  # somebody may have touched the tote
        else:
            if plan.status == "stuck":
                robot.change_tote()
                bearing, placed = None, []
            elif plan.status != "ok":  # impossible or rejected
                robot.call_for_help(f"take the item out: {plan.status} {plan.hints or plan.reasons}")
                missed = []
            elif (outcome := carry(robot, plan)) == "missed":
                missed.append(plan.pick.center)
            elif outcome == "placed":
                bearing, placed, missed = plan.tote_bearing, [*placed, plan.placed], []
            else:  # it may lie anywhere, in the tote too
                robot.call_for_help("an item fell from the gripper")
                bearing, placed, missed = None, [], []
