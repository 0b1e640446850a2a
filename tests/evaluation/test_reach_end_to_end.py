"""A robot with a reach, end to end: training, checkpoint, evaluation with and without another reach, comparison."""

import json
from math import hypot

import pytest
from commands import composed, evaluated
from untrained import write_checkpoint

from pickplace import CellSpec, Planner, load_policy
from pickplace.rules.gripper.rules import Seal
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.reach.table import ReachTable
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.runs.resume import resumed_config
from pickplace.training.train import resume_run

TINY = ["env.tote_size=[6,6,2]", "total_frames=128", "reach=annulus", "env.reach.radii=[4.6,9.7]"]
WIDE_REACH = ([3, 30], [0, 9], [-12, -4, 0], [4, -4, 0])
WIDE = [f"env.reach.{key}={value}" for key, value in zip(("radii", "heights", "bin", "tote"), WIDE_REACH, strict=True)]
EVALUATION = ["evaluation.episodes=2", "evaluation.latency_decisions=0", "evaluation.replay=0", "threads=1"]


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A checkpoint of a run that has not learnt anything yet."""
    return write_checkpoint(tmp_path_factory.mktemp("reach") / "run", CellSpec(), *TINY)


@pytest.fixture
def evaluation(tmp_path):
    """Evaluate in this process; return ``evaluation.json`` with its path, or the error."""

    def call(*words):
        try:
            return evaluated(tmp_path / f"result{len(list(tmp_path.iterdir()))}", *EVALUATION, *words)
        except ValueError as error:
            return str(error)

    return call


def test_a_checkpoint_brings_its_reach(begun, evaluation, run, tmp_path):
    """And ``load_policy`` and ``Planner.load`` know it too."""
    _, facts = checkpoint.read(locate(begun))
    assert facts["config"]["env"]["reach"]["radii"] == [4.6, 9.7]
    policy = load_policy(begun)
    reach = Annulus([4.6, 9.7], [0, 10], [-9, -2.5, 0], [4, -3, 0])
    assert policy.cell.reach == policy.make_env().cell.reach == Planner.load(begun).cell.reach == reach
    assert policy.cell.limits is not None and load_policy(begun, reach=None).cell.limits is None
    other = Annulus([0, 99], [0, 9], [0, 0, 0], [0, 0, 0])
    assert Planner.load(begun, reach=other, tote_size=(7, 5, 4)).cell.reach == other

    plain = evaluation(f"checkpoint={begun}")
    assert plain["env"]["reach"]["radii"] == [4.6, 9.7] and plain["failures"] == {"stuck": 2}
    assert evaluation(f"checkpoint={begun}", "env.reach.heights=[0,1]")["occupancy"]["mean"] <= 0.5
    swapped = ["env.reach.radii=[5,9.8]", "reach=annulus", "env.tote_size=[6,6,1]"]
    run("evaluate", *EVALUATION, f"checkpoint={begun}", *swapped, f"hydra.run.dir={tmp_path}/swapped")
    swapped = json.loads((tmp_path / "swapped" / "evaluation.json").read_text())
    assert swapped["env"]["reach"]["radii"] == [5, 9.8] and swapped["env"]["tote_size"] == [6, 6, 1]
    same = evaluation(f"checkpoint={begun}", f"compare={plain['path']}")
    assert same["paired_difference"]["mean"] == 0
    everywhere = evaluation(f"checkpoint={begun}", "reach=everywhere")
    assert everywhere["env"]["reach"] is None
    error = evaluation(f"checkpoint={begun}", "reach=everywhere", f"compare={plain['path']}")
    assert "env.reach={" in error and "expected None" in error
    for word, expected in (("~reach", "reach="), ("~gripper", "gripper="), ("~reach=null", "reach=")):
        error = evaluation(f"checkpoint={begun}", word)
        assert error.startswith(f"{word}: ") and f"expected {expected}" in error and "\n" not in error
    code, _, printed = run("evaluate", f"checkpoint={begun}", word)
    assert code == 2 and error in printed and printed.count("\n") == 1
    assert "env.reach.radi:" in evaluation(f"checkpoint={begun}", "env.reach.radi=[1,2]")


@pytest.mark.slow
def test_shipped_weights_are_evaluated_with_a_reach_and_another_gripper(evaluation):
    words = ["checkpoint=pretrained/r4", "env.tote_size=[6,6,1]"]
    plain = evaluation(*words)
    assert plain["env"]["reach"] is None
    cup = evaluation(*words, "gripper=point")["env"]["gripper"]
    assert (cup["_target_"], cup["size"]) == ("overlap", [1, 1])
    compare = f"compare={plain['path']}"
    assert evaluation(*words, compare)["paired_difference"]["mean"] == 0
    everywhere = evaluation(*words, "reach=everywhere", compare)
    assert everywhere["paired_difference"]["mean"] == 0 and everywhere["env"]["reach"] is None
    limited = evaluation(*words, "env.reach.radii=[4,7.6]", "reach=annulus")  # no item covers the last row of cells
    assert limited["env"]["reach"]["radii"] == [4, 7.6]
    assert max(limited["occupancy"]["per_episode"]) <= 30 / 36 < min(plain["occupancy"]["per_episode"])
    assert "env.reach=None, expected {" in evaluation(*words, "reach=annulus", compare)
    # Settings that are younger than these weights; nothing lies on anything at this height.
    loads = evaluation(*words, "env.handling=true", "items.max_load=[0,0,0,0]")
    assert loads["env"]["handling"] and loads["occupancy"]["per_episode"] == plain["occupancy"]["per_episode"]
    assert "env.reach.radii: there is no key" in evaluation(*words, "env.reach.radii=[4,9.6]")


def test_tables_are_compared_by_content(evaluation, tmp_path):
    rows = [f"bin,{x},{y},,," for x in range(5) for y in range(5)]
    rows += [f"tote,{x},{y},{r},," for x in range(6) for y in range(6) for r in range(4) if x < 5]
    for name, text in (("a", rows), ("b", rows), ("c", rows[:-1])):
        (tmp_path / f"{name}.csv").write_text("\n".join(["where,x,y,rotation,lowest,highest", *text]))
    words = ["planner=joint_dbl", "env.tote_size=[6,6,2]", "reach=table"]
    first = evaluation(*words, f"env.reach.path={tmp_path}/a.csv")
    compare = f"compare={first['path']}"
    second = evaluation(*words, f"env.reach.path={tmp_path}/b.csv", compare)
    assert second["paired_difference"]["mean"] == 0
    assert "env.reach=" in evaluation(*words, f"env.reach.path={tmp_path}/c.csv", compare)


def test_physics_carries_out_poses_in_reach(evaluation):
    """Each pick and place, with the turned end effector's centre, from the rules to a gantry in metres."""
    pytest.importorskip("mujoco")
    words = ["planner=joint_dbl", "env.tote_size=[6,6,3]", "env.gripper.size=[4,3]", "items=mixed", "reach=annulus"]
    words += ["env.reach.heights=[0.5,2.5]", "env.reach.tote=[4,-3,0.5]", "env.reach.radii=[5.2,9.6]"]
    result = evaluation(*words, "physics=execute", "evaluation.plans=true", "items.height=[1,2]")
    assert set(result["physics"]["endings"]) == {"done"}
    plans = [json.loads(line) for line in (result["path"].parent / "plans.jsonl").read_text().splitlines()]
    assert len(plans) > 10
    for plan in plans:
        picked, placed = plan["size"][2], plan["corner"][2] + plan["size"][2] + 0.025
        for name, corner, face in (("pick", (-0.45, -0.125), picked), ("place", (0.2, -0.15), placed)):
            x, y = (at + start for at, start in zip(plan[name], corner, strict=True))
            assert 0.26 - 1e-6 <= hypot(x, y) <= 0.48 + 1e-6 and 0.025 - 1e-6 <= face <= 0.125 + 1e-6


def test_a_resumed_run_keeps_its_cell(smoke, tmp_path):
    """Options of ``reach`` and ``gripper`` are refused, as other settings of the cell are."""
    run_dir = tmp_path / "run"
    smoke(run_dir, *TINY, "gripper=cup_round", "env.gripper.size=[3,3]", "items.kinds=[[3,3,1],[4,3,1]]", *WIDE)
    cell = load_policy(run_dir).cell
    assert cell.gripper == Seal((3, 3), "disc", "disc", (3, 3)) and cell.reach == Annulus(*WIDE_REACH)
    before = checkpoint.read(locate(run_dir, prefer="last"))[1]
    resume_run([f"resume={run_dir}", "total_frames=256"])
    after = checkpoint.read(locate(run_dir, prefer="last"))[1]
    assert (before["frames"], after["frames"]) == (128, 256) and after["config"]["env"] == before["config"]["env"]
    for word in ("reach=everywhere", "reach=annulus", "gripper=paper", "~reach"):
        with pytest.raises(ValueError, match=f"'{word}': .*'(reach|gripper)' cannot be exchanged"):
            resume_run([f"resume={run_dir}", word, "total_frames=384"])

    assert resumed_config("run", before, ["total_frames=256"]).env.reach == composed(*TINY, *WIDE).env.reach
    with pytest.raises(
        ValueError, match=r"env.reach=\{.*\}: the run began with .*, and a resumed run cannot change it"
    ):
        resumed_config("run", before, ["env.reach.radii=[1,20]"])


def test_a_robot_does_without_the_table_of_the_training(tmp_path):
    path = tmp_path / "reach.csv"
    rows = [f"bin,{x},{y},,," for x in range(5) for y in range(5)]
    rows += [f"tote,{x},{y},{r},," for x in range(6) for y in range(6) for r in range(4)]
    path.write_text("\n".join(["where,x,y,rotation,lowest,highest", *rows]))
    words = ["env.tote_size=[6,6,5]", "reach=table", f"env.reach.path={path}"]
    folder = write_checkpoint(tmp_path / "run", CellSpec(), *words)
    assert Planner.load(folder).cell.reach == ReachTable(str(path))
    path.unlink()
    with pytest.raises(ValueError, match="reach.csv': no such file"):
        Planner.load(folder)
    assert Planner.load(folder, reach=None).cell.reach is None
