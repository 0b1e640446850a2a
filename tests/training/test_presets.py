"""Every preset, every model and every teacher trains."""

import logging

import pytest
from commands import TINY, composed, options

from pickplace.runs.loggers import read_csv
from pickplace.training import report, trainer
from pickplace.training.train import train

ONCE = ["evaluation_interval=48", "checkpoint_interval=48", "progress_interval=48"]  # for a training of three batches
AFTERSTATE = ("afterstate", "afterstate_fcn")  # models whose network is the critic, too
ONE_NETWORK = [word for word in TINY if not word.startswith("model.critic.")]


#: Presets that differ from another one in numbers only.
LIKE_OTHERS = ("afterstate_gpu", "paper_fast_gpu", "paper_gpu")


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] * (name in LIKE_OTHERS)) for name in options("experiment")
])  # fmt: skip
def test_every_preset_runs(name, tmp_path, monkeypatch):
    """And ends in a report. Its figures, which are the same for all presets, take most of the time."""
    if name != "smoke":
        monkeypatch.setattr(trainer, "learning_curve", lambda metrics, path, *_: path.touch())
        monkeypatch.setattr(report, "failure_mix", lambda rows: b"")
    sizes = {
        "smoke": [4, 4, 1],
        "mixed_grasp": [7, 7, 3],
        "mixed": [7, 7, 3],
        "buffer": [7, 7, 5],
        "warehouse": [16, 12, 60],
        "orders": [40, 35, 200],
    }
    extra = [f"env.tote_size={sizes[name]}".replace(" ", "")] if name in sizes else []
    extra += ["items.depth=[9,10]"] * (name == "warehouse")  # fewer kinds
    extra += ["warm_start.weights=null"] * (name == "buffer")  # of another size than these networks
    extra += ["device=cpu"] * name.endswith("_gpu")
    if name == "orders":
        lines = (f"{order},{300 + 20 * order},200,300,1" for order in range(4) for _ in range(2))
        (orders := tmp_path / "orders.csv").write_text("\n".join(("order,length,width,height,weight", *lines)))
        extra += [f"items.path={orders}", "evaluation.episodes=1"]
    tiny = TINY if composed(f"experiment={name}")["model"]["critic"] else ONE_NETWORK
    assert 0 <= train(composed(f"experiment={name}", *tiny, *extra), tmp_path) <= 1
    assert [row["frames"] for row in read_csv(tmp_path / "metrics.csv")] == [16]
    (tmp_path / "orders.csv").unlink(missing_ok=True)
    files = {".lock", "checkpoints", "learning_curve.png", "metrics.csv", "report.html"}
    assert {path.name for path in tmp_path.iterdir()} - {"learning_curve.pdf", "learning_curve.svg"} == files


NOT_TRAINED = {"gopt_50", "gopt_100", "bed_bpp", "bed_bpp_roll"}


@pytest.mark.parametrize("name", sorted({*options("benchmark")} - NOT_TRAINED))
def test_a_benchmark_is_trained_on(name, tmp_path, no_report):
    unit = composed(f"benchmark={name}")["items"].get("unit", 1)
    tiny = ["model=afterstate", "algo=td", *ONE_NETWORK] if unit > 1 else TINY
    words = [f"benchmark={name}", *tiny, f"env.tote_size=[{6 * unit},{6 * unit},{5 * unit}]"]
    assert 0 <= train(composed(*words), tmp_path) <= 1


@pytest.mark.parametrize("unit", [3, 5, 10])
def test_a_larger_benchmark_is_a_scaled_one(unit):
    plain, cfg = composed("benchmark=gopt_rs"), composed(f"benchmark=gopt_{10 * unit}")
    assert cfg["items"] == {**plain["items"], "unit": unit}
    sizes = {"bin_size": [5 * unit, 5 * unit, 1], "tote_size": [10 * unit] * 3}
    assert cfg.env == {**plain.env, **sizes}


@pytest.mark.parametrize(("name", "masked"), [
    *((name, True) for name in options("gripper")), ("paper", False), ("cup_round", False),
])  # fmt: skip
def test_every_effector_trains(name, masked, tmp_path):
    kinds = ["items.kinds=[[5,4,1],[4,4,2]]", "env.bin_size=[9,9,1]", "env.tote_size=[11,10,2]"]
    words = [f"gripper={name}", f"model.mask_infeasible={masked}", "curriculum=none", "logger=none", *TINY]
    assert 0 <= train(composed(*words, *(kinds if name == "cup_round" else [])), tmp_path) <= 1


@pytest.mark.parametrize("env", options("env"))
def test_the_paper_s_effector_is_the_default(env):
    assert composed(f"env={env}").env == composed(f"env={env}", "gripper=paper").env


@pytest.mark.parametrize("model", options("model"))
def test_every_model_trains_with_and_without_a_mask(model, tmp_path):
    """By its usual algorithm, and by ``sampled_ppo``, without a mask for one model only."""
    algorithms = {**dict.fromkeys(AFTERSTATE, "algo=td"), "fcn_grasp": "algo=a2c"}
    samples = ["algo=sampled_ppo", "algo.samples=2"]
    cases = [(True, [algorithms.get(model, "algo=ppo")]), (False, ["algo=ppo"])]
    cases += [(True, samples)] * (model not in AFTERSTATE) + [(False, samples)] * (model == "fcn_grasp")
    overrides = [f"model={model}", "curriculum=none", "logger=none", "env.rotations=2"]
    cfg = composed(*overrides, *(ONE_NETWORK if model in AFTERSTATE else TINY))
    for number, (masked, algo) in enumerate(cases):
        cfg.model.mask_infeasible, cfg.algo = masked, composed(*algo, *TINY).algo
        if model in AFTERSTATE and not masked:
            with pytest.raises(ValueError, match=r"^model.mask_infeasible=False: expected true"):
                train(cfg, tmp_path)
        else:
            run_dir = tmp_path / str(number)
            run_dir.mkdir()
            assert 0 <= train(cfg, run_dir) <= 1


@pytest.mark.parametrize("name", options("planner"))
def test_any_planner_can_be_imitated(name, tmp_path, no_report):
    settings = {"mcts": {"simulations": 20}, "lookahead": {"samples": 2, "rounds": 1}}.get(name, {})
    words = [f"warm_start.teacher.{key}={value}" for key, value in settings.items()]
    checkpoint = {"policy": "r4", "lookahead": "r4", "beam": "mixed"}.get(name)
    words += [f"warm_start.checkpoint=pretrained/{checkpoint}"] if checkpoint else []
    words += ["warm_start=imitate", f"planner@warm_start.teacher={name}", "warm_start.frames=16"]
    cfg = composed("curriculum=none", *words, *TINY, "warm_start.critic_frames=16", "total_frames=48", *ONCE)
    assert 0 <= train(cfg, tmp_path) <= 1
    assert ["train/agreement" in row for row in read_csv(tmp_path / "metrics.csv")] == [True, False, False]


@pytest.mark.parametrize(("height", "told"), [(1, True), (2, False)])
def test_the_console_tells_of_a_tote_that_did_not_grow(caplog, tmp_path, height, told):
    caplog.set_level(logging.INFO)
    settings = ["env.tote_size=[4,4,2]", "curriculum=adaptive", f"curriculum.start_height={height}", "threads=1"]
    training = trainer.Trainer(composed("experiment=smoke", *settings), tmp_path)
    training.report(stopped=False)
    training.collector.shutdown()
    assert ("the curriculum came to tote height 1 of 2 only" in caplog.text) == told


def test_the_paper_preset_is_the_paper_s():
    paper = composed("experiment=paper")
    assert (paper.algo.lr, paper.algo.gamma, paper.rollout_length, paper.env.num_envs) == (2.5e-4, 0.99, 32, 16)
    assert (paper.algo.critic_coeff, paper.algo.entropy_coeff, paper.model.mask_infeasible) == (0.005, 0.002, False)
    assert paper.curriculum.advance.frames_per_level == 5_000_000
