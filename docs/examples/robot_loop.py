"""The loop of a robot cell. ``robot`` is yours; simulated_robot.py has one."""

from pickplace import DepthMapError, EmptyBinError, Scene

ATTEMPTS, MARGIN = 3, 0.03  # bad images before a call for help; height above all that is passed, m


def carry(robot, plan) -> str:
    """Carry out a plan; return ``"placed"``, ``"missed"``, or ``"lost"`` on the way."""
    pick, place = robot.base_from_bin @ plan.pick.matrix, robot.base_from_tote @ plan.place.matrix
    above_pick, above_place = pick.copy(), place.copy()
    above_pick[2, 3] = above_place[2, 3] = robot.highest + plan.pick.center[2] + MARGIN
    robot.move(above_pick)
    robot.move(pick)
    robot.suck()
    robot.move(above_pick)
    if not robot.holds_item():
        return "missed"
    robot.move(above_place)
    if not robot.holds_item():
        return "lost"
    robot.move(place)
    robot.release()
    robot.move(above_place)
    return "placed"


def pack(robot, planner, cell_size: float, sizes=None) -> None:
    """Pack tote after tote until no item arrives. ``sizes`` of all items tell two that touch from one; m."""
    bearing, placed, missed, refused = None, [], [], 0
    while True:
        try:
            scene = Scene.from_images(
                planner.cell, *robot.look(), cell_size, sizes=sizes, tote_bearing=bearing, placed=placed
            )
            plan, refused = planner.plan(scene, exclude=missed), 0
        except EmptyBinError:
            missed, refused = [], 0
            if not robot.wait_for_items():
                return
            continue
        except DepthMapError as error:  # take new images
            refused += 1
            if refused % ATTEMPTS == 0:
                robot.call_for_help(str(error))
                bearing, placed, missed = None, [], []  # somebody may have touched the tote
            continue
        outcome = carry(robot, plan) if plan.status == "ok" else plan.status
        if outcome == "placed":
            bearing, placed, missed = plan.tote_bearing, [*placed, plan.placed], []
        elif outcome == "missed":
            missed.append(plan.pick.center)
        elif outcome == "stuck":
            robot.change_tote()
            bearing, placed = None, []
        elif outcome == "lost":  # it may lie in the tote
            robot.call_for_help("an item fell")
            bearing, placed, missed = None, [], []
        else:  # impossible or rejected
            item = "an item" if plan.item_number is None else f"items[{plan.item_number}]"
            robot.call_for_help(f"take {item} out: {plan.hints or plan.reasons}")
            missed = []
