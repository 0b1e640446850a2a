"""``pickplace-evaluate``: its files, and comparisons of the same episodes."""

import json

import pytest


@pytest.fixture(scope="module")
def smoke_run(smoke, tmp_path_factory):
    """A small finished run."""
    run_dir = tmp_path_factory.mktemp("smoke") / "run"
    smoke(run_dir)
    return run_dir


@pytest.mark.parametrize(
    "search", [["lookahead", "planner.samples=2", "planner.rounds=1"], ["mcts", "planner.simulations=8"]]
)
def test_evaluation_of_a_search(search, run, smoke_run, tmp_path):
    arguments = [f"planner={search[0]}", *search[1:], f"checkpoint={smoke_run}", "evaluation.episodes=2"]
    code, _, err = run("evaluate", *arguments, "evaluation.latency_decisions=0", "hydra.run.dir=result")
    assert code == 0, err
    result = json.loads((tmp_path / "result" / "evaluation.json").read_text())
    assert result["planner"] == search[0] and 0 < result["occupancy"]["mean"] <= 1
    wanted = dict(word.removeprefix("planner.").split("=") for word in search[1:])
    assert {key: str(result["planner_settings"][key]) for key in wanted} == wanted
    assert ("mean_tree_depth" in result) == (search[0] == "mcts")


def test_evaluation_of_a_run(run, smoke_run, tmp_path):
    arguments = [f"checkpoint={smoke_run}", "evaluation.episodes=6", "env.tote_size=[5,5,2]", "planner.candidates=10"]
    arguments += ["model.actor.compute_dtype=bfloat16"]
    code, out, err = run("evaluate", *arguments, "hydra.run.dir=result")
    assert code == 0, err
    assert "occupancy" in out
    result = json.loads((tmp_path / "result" / "evaluation.json").read_text())
    assert set(result) >= {
        "planner", "env", "episodes", "seed", "occupancy", "items_placed", "failures", "feasible_action_share",
        "latency_ms", "versions", "commit", "mask_in_training", "mask_at_decision", "candidates",
    }  # fmt: skip
    assert set(result["occupancy"]) == {"mean", "ci95", "min", "per_episode"}
    assert len(result["occupancy"]["per_episode"]) == 6
    assert result["env"]["tote_size"] == [5, 5, 2] and result["candidates"] == 10
    assert result["mask_in_training"] is True and result["mask_at_decision"].startswith("failed picks")
    assert {path.name for path in (tmp_path / "result").iterdir()} >= {"tote.png", "evaluation.md"}


def test_paired_difference(run, tmp_path):
    settings = ["env.tote_size=[4,4,1]", "evaluation.episodes=20", "evaluation.latency_decisions=0"]
    assert run("evaluate", "planner=random", *settings, "hydra.run.dir=a")[0] == 0
    code, out, err = run("evaluate", "planner=joint_dbl", *settings, "hydra.run.dir=b", "compare=a/evaluation.json")
    assert code == 0, err
    a, b = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in "ab")
    paired = b["paired_difference"]
    assert paired["against"] == "random" and "minus random" in out
    assert paired["mean"] == pytest.approx(b["occupancy"]["mean"] - a["occupancy"]["mean"])
    assert paired["ci95"][0] < paired["mean"] < paired["ci95"][1]
    code, _, err = run("evaluate", "planner=joint_dbl", *settings, "evaluation.seed=1", "compare=a/evaluation.json")
    assert code == 2 and "its seed is 0, expected 1" in err


def test_only_the_same_episodes_are_compared(run):
    settings = ["env.tote_size=[4,4,1]", "evaluation.episodes=2", "evaluation.latency_decisions=0", "planner=joint_dbl"]
    assert run("evaluate", *settings, "hydra.run.dir=a")[0] == 0
    for key, value in (
        ("env.rotations", 2), ("env.effector_size", [2, 3]), ("env.bin_size", [5, 4, 1]), ("env.tote_size", [4, 5, 1]),
        ("env.pick_rule", "overlap"), ("env.min_support", 0.25), ("env.strict_support", True),
        ("evaluation.episodes", 3), ("evaluation.stream", "validation"), ("items", "mixed"),
    ):  # fmt: skip
        more = ["env.tote_size=[7,7,3]"] if key == "items" else []
        code, _, err = run("evaluate", *settings, *more, f"{key}={value}".replace(" ", ""), "compare=a/evaluation.json")
        wanted = key if key.startswith("env.") else f"its {key.removeprefix('evaluation.')} is"
        assert code == 2 and wanted in err, (key, err)
