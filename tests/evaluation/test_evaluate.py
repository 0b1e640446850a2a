"""``pickplace-evaluate``: what it writes, what it compares, and planners of the user's own."""

import base64
import json
import math
import re
import zlib
from itertools import product

import numpy
import pytest
import torch
from commands import composed, evaluated, evaluation_config
from untrained import write_checkpoint

from pickplace import CellSpec, PickPlaceEnv
from pickplace.config.registry import build
from pickplace.evaluation.artifacts import evaluation_table
from pickplace.evaluation.evaluate import load_trained, prepare
from pickplace.evaluation.play import play
from pickplace.evaluation.result import episode_settings, read_comparison
from pickplace.physics.plans import read_plans
from pickplace.physics.settle import Settle
from pickplace.planners.heuristics import JointDBL
from pickplace.rules.cell import MAX_ACTIONS
from pickplace.views.motion import Outcome

SMALL = ["env.tote_size=[4,4,2]", "evaluation.latency_decisions=0", "evaluation.replay=0"]
JOINT = ["planner=joint_dbl", *SMALL]


@pytest.fixture
def evaluation(tmp_path):
    """Evaluate in an empty folder; return ``evaluation.json``, with the table."""

    def call(*arguments, refused=None):
        folder = tmp_path / f"result{len(list(tmp_path.iterdir()))}"
        if refused is None:
            return evaluated(folder, *arguments)
        with pytest.raises(ValueError) as caught:
            evaluated(folder, *arguments)
        assert refused in str(caught.value)
        return None

    return call


@pytest.fixture
def command(run, tmp_path):
    """Evaluate by the command line; return ``evaluation.json``, with the printed table."""

    def call(*arguments):
        folder = tmp_path / "command"
        code, out, err = run("evaluate", *arguments, f"hydra.run.dir={folder}")
        assert code == 0, err
        path = folder / "evaluation.json"
        return {**json.loads(path.read_text()), "out": out, "path": path}

    return call


def test_shipped_weights_play_with_several_items(evaluation):
    few = [*SMALL[1:], "env.tote_size=[5,5,4]", "evaluation.episodes=3", "threads=1"]
    one = evaluation("checkpoint=pretrained/mixed_grasp", *few)
    several = evaluation("checkpoint=pretrained/mixed_grasp", "env.bin_items=2", "env.bin_size=[6,6,1]", *few)
    assert "| items in the bin " in several["out"] and "up to 2, refill: each" in several["out"]
    assert "items in the bin" not in one["out"] and one["env"]["bin_items"] == 1
    path = one["path"]
    evaluation(
        "checkpoint=pretrained/mixed_grasp", "env.bin_items=2", *few, f"compare={path}",
        refused="env.bin_items=1, expected 2",
    )  # fmt: skip


def test_shipped_weights_plan_with_a_preview(evaluation):
    few = [*SMALL[1:], "env.tote_size=[4,4,3]", "evaluation.episodes=12", "threads=1", "checkpoint=pretrained/mixed"]
    beam = [*few, "planner=beam", "planner.depth=4"]
    none = evaluation(*beam)
    seen = evaluation(*beam, "env.preview=3", f"compare={none['path']}")  # the same episodes
    assert "| items in the preview " in seen["out"] and "items in the preview" not in none["out"]
    assert seen["paired_difference"]["mean"] > 0.01


@pytest.mark.parametrize(("side", "episodes"), [(30, 1000), (50, 1000), (100, 100)])
def test_larger_benchmarks_are_gopt_rs_on_a_finer_grid(side, episodes):
    small, cfg = (composed(f"benchmark={name}", name="evaluate") for name in ("gopt_rs", f"gopt_{side}"))
    scale = side // 10
    sizes = [build("items", each["items"]).sizes for each in (small, cfg)]
    assert torch.equal(sizes[1], scale * sizes[0])
    assert cfg.env.tote_size == [side] * 3 and cfg.env.bin_size == [5 * scale, 5 * scale, 1]
    assert {**cfg.env, "tote_size": 0, "bin_size": 0} == {**small.env, "tote_size": 0, "bin_size": 0}
    assert cfg.evaluation.episodes == episodes


def test_orders_with_a_checkpoint_have_its_cells():
    words = ["checkpoint=pretrained/warehouse", "items=orders", "items.path=docs/examples/orders/orders.csv"]
    older = ["checkpoint=pretrained/mixed"]  # its config has no size of a cell
    for extra, expected in (
        ([], (0.02, 0.25)), (["env.cell_size=0.03", "items.height_unit=0.5"], (0.03, 0.5)), (older, (0.05, 1)),
    ):  # fmt: skip
        with evaluation_config(*words, *extra) as cfg:
            load_trained(cfg)
        assert (cfg["items"].cell_size, cfg["items"].height_unit) == expected


@pytest.mark.parametrize(
    ("name", "target", "base", "fine"),
    [
        ("bed_bpp", "euro-pallet", (1.2, 0.8), ["env.tote_size=[120,80,200]", "env.bin_size=[80,80,1]"]),
        ("bed_bpp_roll", "rollcontainer", (0.8, 0.7), ["env.tote_size=[80,70,200]", "env.bin_size=[80,80,1]"]),
    ],
)
def test_orders_of_bed_bpp_go_where_they_are_for(evaluation, tmp_path, name, target, base, fine):
    fine += ["env.cell_size=0.01", "env.height_unit=1", "env.support.margin=2"]
    for extra in ([], fine):
        env = composed(f"benchmark={name}", "items.path=a", *extra, name="evaluate").env
        assert [side * env.cell_size for side in env.tote_size[:2]] == pytest.approx(base)
        assert env.tote_size[2] * env.height_unit * env.cell_size == pytest.approx(2)
        assert env.support.margin * env.cell_size == pytest.approx(0.02)
        assert math.prod(env.bin_size[:2]) * math.prod(env.tote_size[:2]) * env.rotations <= MAX_ACTIONS
    box = {"length/mm": 600, "width/mm": 390, "height/mm": 305, "weight/kg": 4}
    (path := tmp_path / "orders.json").write_text(json.dumps({
        goal: {"item_sequence": {str(n): box for n in range(1, count)}, "properties": {"target": goal}}
        for goal, count in (("euro-pallet", 4), ("rollcontainer", 3))
    }))  # fmt: skip
    words = [f"benchmark={name}", f"items.path={path}", "planner=joint_dbl", *SMALL[1:], "evaluation.episodes=1"]
    result = evaluation(*words)
    count = {"euro-pallet": 3, "rollcontainer": 2}[target]
    assert result["share_placed"]["mean"] == 1 and result["items_placed"] == count
    assert result["true_occupancy"]["mean"] == pytest.approx(count * 0.6 * 0.39 * 0.305 / (2 * base[0] * base[1]))
    with pytest.raises(ValueError, match="^evaluation.stream=validation: the items have no episodes for it; expected"):
        evaluation(*words, "evaluation.stream=validation")


@pytest.mark.parametrize(
    ("name", "least", "rotations", "support", "episodes"),
    [
        ("gopt_rs", 1, 2, "half_or_hull", 1000),
        ("pct1", 1, 2, "bearing", 1000),
        *((name, 2, 1, "corners", 2000) for name in ("cdrl_rs", "cut1", "cut2")),
    ],
)
def test_benchmarks_are_the_papers_settings(evaluation, name, least, rotations, support, episodes):
    cfg = composed(f"benchmark={name}", name="evaluate")
    sizes = build("items", cfg["items"]).sizes.tolist()
    assert sorted(sizes) == [list(size) for size in product(range(least, 6), repeat=3)]
    drawn = cfg["items"].get("drawn", cfg["items"])
    assert drawn.get("order") == {"cut1": "z", "cut2": "stacking"}.get(name)
    assert drawn.get("container", cfg.env.tote_size) == cfg["items"].get("end", cfg.env.tote_size) == cfg.env.tote_size
    assert cfg.evaluation.episodes == episodes
    assert (cfg.env.tote_size, cfg.env.rotations) == ([10, 10, 10], rotations)
    assert (cfg.env.gripper.size, cfg.env.gripper._target_, cfg.env.bin_size) == ([1, 1], "overlap", [5, 5, 1])
    short = [f"benchmark={name}", "evaluation.episodes=2", *SMALL[1:]]
    first = evaluation("planner=joint_dbl", *short)
    assert first["failures"] == {"stuck": 2} and first["env"]["support"]["_target_"] == support
    with evaluation_config("checkpoint=pretrained/mixed", *short, "env.tote_size=[10,10,6]") as cfg:
        prepare(cfg)
    second = episode_settings(cfg)
    for items in (first["items"], first["items"].get("drawn", {})):  # what is the tote's size
        items |= {key: [10, 10, 6] for key in ("end", "container") if key in items}
    assert second["items"] == first["items"]
    assert second["env"] == {**first["env"], "tote_size": [10, 10, 6]}


@pytest.mark.parametrize(("group", "stream", "seed"), [("default", "test", 7), ("validation", "validation", 3)])
def test_evaluation_json(command, evaluation, group, stream, seed):
    settings = [f"evaluation={group}", f"evaluation.seed={seed}", "evaluation.episodes=5"]
    settings += ["evaluation.latency_decisions=3", "env.tote_size=[4,5,2]", "evaluation.batch_size=2"]
    words = ["planner=joint_dbl", "planner.item=first"]
    result = (command if group == "default" else evaluation)(*words, *settings)
    assert (result["planner"], result["episodes"], result["seed"], result["stream"]) == ("joint_dbl", 5, seed, stream)
    assert result["env"]["tote_size"] == [4, 5, 2] and result["env"]["rotations"] == 4
    occupancy, latency = result["occupancy"], result["latency_ms"]
    assert sum(result["failures"].values()) == 5 and occupancy["min"] == min(occupancy["per_episode"])
    assert occupancy["mean"] == pytest.approx(sum(occupancy["per_episode"]) / 5)
    assert occupancy["ci95"][0] <= occupancy["mean"] <= occupancy["ci95"][1]
    assert 0 < latency["p50"] <= latency["p95"] < 60_000
    assert set(result["versions"]) >= {"pickplace", "torch", "torchrl", "tensordict", "python"}
    assert {path.name for path in result["path"].parent.iterdir()} >= {"tote.png", "evaluation.md"}
    assert "| joint_dbl item=first " in result["out"]

    def make_env(first, count):
        settings = {"tote_size": (4, 5, 2), "stream": stream, "seed": seed, "masks": ()}
        return PickPlaceEnv(num_envs=count, first_episode=first, **settings)

    assert play(make_env, JointDBL(make_env(0, 1).cell), 5, 5).occupancy.tolist() == occupancy["per_episode"]


def test_evaluation_of_a_checkpoint(evaluation, tmp_path):
    folder = write_checkpoint(tmp_path / "it", CellSpec(rotations=2), "env.rotations=2")
    arguments = [f"checkpoint={folder}", *SMALL, "env.tote_size=[5,5,2]", "evaluation.episodes=8"]
    one, best = (evaluation(*arguments, f"planner.candidates={candidates}") for candidates in (1, "all"))
    assert one["trained"]["frames"] == 256 and one["latency_ms"] is None and one["env"]["tote_size"] == [5, 5, 2]
    # With a mask in training it has never learnt to avoid what cannot be picked, and cannot choose it either.
    outside = "failed picks and footprints outside the tote"
    assert (one["candidates"], one["mask_in_training"], one["mask_at_decision"]) == (1, True, outside)
    assert (best["candidates"], best["mask_in_training"], best["mask_at_decision"]) == ("all", True, True)
    assert best["failures"] == {"stuck": 8}
    assert set(one["failures"]) != {"stuck"}  # not trained, without a mask: some actions fail
    assert one["occupancy"]["mean"] < best["occupancy"]["mean"]
    half = [*arguments, "evaluation.episodes=1", "model.actor.compute_dtype=bfloat16"]
    search = ["planner=lookahead", "planner.samples=2", "planner.rounds=1", "planner.candidates=2"]
    found = evaluation(*half, *search)
    assert (found["planner"], found["candidates"], found["mask_at_decision"]) == ("lookahead", "all", True)
    assert {key: found["planner_settings"][key] for key in ("samples", "rounds")} == {"samples": 2, "rounds": 1}
    found = evaluation(*half, "planner=mcts", "planner.simulations=8")
    assert found["planner_settings"]["simulations"] == 8 and "mean_tree_depth" in found


def test_physics_and_plans(evaluation, tmp_path):
    """A table that says what was carried out, and plans with which ``pickplace-physics`` comes to the same."""
    pytest.importorskip("mujoco")
    settings = ["planner=joint_dbl", "items=mixed", *SMALL, "env.tote_size=[6,6,4]", "evaluation.episodes=4"]
    physics = ["physics=settle", "physics.friction=0.5", "env.cell_size=0.04", "evaluation.plans=true"]
    result = evaluation(*settings, *physics)
    found, plans = result["physics"], read_plans(result["path"].parent / "plans.jsonl")
    assert (found["method"], found["settings"]["friction"]) == ("settle", 0.5)
    assert sum(found["endings"].values()) == len(plans) == 4 and plans[0].tote == (0.24, 0.24, 0.16)
    share = found["endings"].get("done", 0) / 4
    assert found["carried_out"]["mean"] == share and f"{share:.1%} of the episodes to their end" in result["out"]
    outcomes = [outcome.facts() for outcome in Settle(friction=0.5).carry_out(plans)]
    for ours, theirs, by_rules in zip(outcomes, found["episodes"], result["occupancy"]["per_episode"], strict=True):
        assert ours | {"cpu_seconds": 0} == theirs | {"cpu_seconds": 0}
        assert theirs["occupancy"] <= by_rules + 1e-9
        assert theirs["ending"] != "done" or theirs["occupancy"] == pytest.approx(by_rules)
    mean = sum(outcome["occupancy"] for outcome in outcomes) / 4
    assert found["occupancy"]["mean"] == pytest.approx(mean) and f"{mean:.4f}" in result["out"]
    assert len(found["occupancy"]["per_episode"]) == 4 and found["drift"] == max(one["drift"] for one in outcomes)
    assert "physics" not in evaluation(*settings) and not list(tmp_path.glob("MUJOCO*"))
    evaluation(*settings, "physics=settle", "physics.gap=1", refused="physics.gap=1: ")


def test_items_of_a_checkpoint_and_other_ones(command, evaluation):
    """A key of the checkpoint's items is not one of the command's own items."""
    arguments = ["checkpoint=pretrained/mixed", *SMALL, "env.tote_size=[6,6,1]", "evaluation.episodes=2"]
    result = command(*arguments, "items.height=[1,1]")
    assert (result["items"]["width"], result["items"]["height"]) == ([1, 3], [1, 1])
    assert evaluation(*arguments, "items=kinds", "items.kinds=[[1,1,1]]")["items"]["kinds"] == [[1, 1, 1]]


def test_paired_difference(evaluation):
    settings = [*SMALL, "env.tote_size=[4,4,1]", "evaluation.episodes=20"]
    a = evaluation("planner=random", *settings)
    b = evaluation("planner=joint_dbl", *settings, f"compare={a['path']}")
    paired = b["paired_difference"]
    assert paired["against"] == "random" and "minus random" in b["out"]
    assert paired["mean"] == pytest.approx(b["occupancy"]["mean"] - a["occupancy"]["mean"])
    assert paired["ci95"][0] < paired["mean"] < paired["ci95"][1]


@pytest.mark.parametrize("word", [
    "env.rotations=2", "env.gripper.size=[2,3]", "env.bin_size=[5,4,1]", "env.tote_size=[4,5,1]",
    "env.gripper._target_=overlap", "env.support=hull", "env.support={_target_: bearing, margin: 0.1}",
    "evaluation.seed=1", "evaluation.episodes=3", "evaluation.stream=validation", "items=mixed",
])  # fmt: skip
def test_only_the_same_episodes_are_compared(word, tmp_path):
    ours, theirs = (episode_settings(composed(*words, name="evaluate")) for words in ([], [word]))
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps({**ours, "planner": "a", "occupancy": {"per_episode": [0.5] * 100}}))
    read_comparison(path, ours)
    key = word.partition("=")[0].removeprefix("evaluation.")
    key = key.removesuffix("._target_")
    with pytest.raises(ValueError, match=key if "." in key else f"its {key} is "):
        read_comparison(path, theirs)


def test_a_default_that_one_config_lacks_is_compared(tmp_path):
    ours = episode_settings(composed("items=mixed", name="evaluate"))
    older = {**ours, "items": {key: value for key, value in ours["items"].items() if key != "unit"}}
    for mine, theirs in ((ours, older), (older, ours)):
        path = tmp_path / "evaluation.json"
        path.write_text(json.dumps({**theirs, "planner": "a", "occupancy": {"per_episode": [0.5] * 100}}))
        read_comparison(path, mine)


def test_recorded_items_are_compared_by_content_and_not_by_path(evaluation, tmp_path):
    table, moved = tmp_path / "items.csv", tmp_path / "moved.csv"
    arguments = [*JOINT, "items=recorded", "evaluation.episodes=2"]
    table.write_text("w,d,h\n1,1,1\n2,1,1\n")
    first = evaluation(*arguments, f"items.path={table}")
    assert "same_items" not in first  # their places differ
    arguments += [f"items.path={table.rename(moved)}"]
    assert evaluation(*arguments, f"compare={first['path']}")["paired_difference"]["mean"] == 0
    moved.write_text("w,d,h,x,y\n2,1,1,0,3\n2,1,1,0,3\n")
    evaluation(*arguments, f"compare={first['path']}", refused="its items is")  # the command, too
    result = evaluation(*arguments)
    assert result["same_items"] and ", all of the same items" in evaluation_table(result)


class Counting(JointDBL):
    """Reports what JSON does not know."""

    name = "counting"

    def evaluation_facts(self):
        return {"known_first": 5}

    def statistics(self):
        return {"seen": torch.tensor([3, 4]), "share": numpy.float32(0.5), "device": torch.device("cpu")}


class Nameless(JointDBL):
    name = None


def test_own_planners_add_to_the_result(evaluation):
    arguments = [*JOINT, "evaluation.episodes=2", "trust=[test_evaluate]"]
    result = evaluation(*arguments, "planner._target_=test_evaluate.Counting")
    assert [result[key] for key in ("known_first", "seen", "share", "device")] == [5, [3, 4], 0.5, "cpu"]
    refused = "planner: Nameless has no name; expected"
    assert evaluation(*arguments, "planner._target_=test_evaluate.Nameless", refused=refused) is None


class Clumsy:
    """A physics engine without bodies: the second item of every episode is lost."""

    name = "clumsy"

    def __init__(self, skip: bool = False):
        self.skip = skip

    def carry_out(self, plans, record=()):
        for plan in plans[self.skip :]:
            volume = plan.placements[0].volume / (plan.tote[0] * plan.tote[1] * plan.tote[2])
            yield Outcome(plan.episode, "slipped", 1, 1, 1, volume)


@pytest.mark.slow
def test_a_physics_engine_of_ones_own(command, evaluation):
    """One class; it needs no MuJoCo, and its config may be a file."""
    words = [*SMALL[:2], "planner=joint_dbl", "evaluation.episodes=3", "evaluation.plans=true", "evaluation.replay=2"]
    result = command(*words, "+physics._target_=test_evaluate.Clumsy", "env.cell_size=0.2")
    found, plans = result["physics"], read_plans(result["path"].parent / "plans.jsonl")
    assert (found["method"], found["settings"], found["endings"]) == ("clumsy", {}, {"slipped": 3})
    assert plans[0].tote == (0.8, 0.8, 0.4) and found["carried_out"]["mean"] == 0
    volumes = [plan.placements[0].volume / 0.256 for plan in plans]
    assert found["occupancy"]["per_episode"] == pytest.approx(volumes)
    html = (result["path"].parent / "replay.html").read_text()
    shown = json.loads(zlib.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', html)[1])))["episodes"]
    assert "clumsy" in html and [episode["label"] for episode in shown] == ["slipped", "slipped"]
    assert [episode["occupancy"] for episode in shown] == found["occupancy"]["per_episode"][:2]
    own = "+physics._target_=test_evaluate."
    evaluation(*words, f"{own}Clumsy", "+physics.skip=true", refused="physics=clumsy: outcomes of the episodes [1, 2]")
    evaluation(*words, f"{own}Clumsy", "+physics.speed=1", refused="physics.speed: ")
    evaluation(*words, f"{own}Counting", refused="physics._target_=test_evaluate.Counting: ")
