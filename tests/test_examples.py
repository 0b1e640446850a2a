"""The examples in docs/examples/ train, evaluate and plan."""

import ast
import csv
import importlib
import itertools
import json
import math
import runpy
import shutil
import signal
from pathlib import Path
from types import SimpleNamespace

import nbclient
import nbformat
import numpy as np
import pytest
import torch
from commands import after_batch, assert_same, composed
from hydra import compose, initialize_config_dir

from pickplace import Box, CellSpec, PickPlaceEnv, Planner, Scene, load_policy
from pickplace.algorithms.base import BatchPosition, Task
from pickplace.config.registry import build
from pickplace.config.words import conf_dir
from pickplace.items.distributions import Kinds
from pickplace.items.order_file import OrderItem
from pickplace.physics.plans import EpisodePlan, Placement
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.observation import STANDARD_TERMS
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.runs.loggers import read_csv
from pickplace.serve import json_lines
from pickplace.training.train import train

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "docs" / "examples"
EVALUATION = ["evaluation.episodes=3", "evaluation.latency_decisions=0", "evaluation.replay=0", "threads=1"]
TRAINING = ["env.num_envs=8", "total_frames=64", "evaluation.episodes=4", "threads=1", "logger=none"]
BIN, TOTE = np.zeros((5, 5)), np.full((6, 6), 5)
BIN[1:3, 2] = 1


@pytest.fixture
def example(run, no_report, monkeypatch, tmp_path):
    """Run a command with an example's folder, from the root of the checkout; return its result, or its run folder.

    It draws no figures.
    """
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("pickplace.evaluation.artifacts.picture", lambda recording, cell, path: path.touch())

    def call(command, name, *arguments, refused=None, code=0):
        monkeypatch.syspath_prepend(str(EXAMPLES / name))
        folder = tmp_path / f"{command}{len(list(tmp_path.iterdir()))}"
        words = ["--config-dir", str(EXAMPLES / name), *arguments, f"hydra.run.dir={folder}"]
        found, _, err = run(command, *(arguments if arguments[0].startswith("resume=") else words))
        assert (found == 2 and refused in err) if refused else found == code, err
        path = folder / "evaluation.json"
        return json.loads(path.read_text()) if path.is_file() else folder

    return call


def trained(name, folder, *words):
    """Train with an example's folder, in half of the command's time; return the run folder."""
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES / name))
        train(composed(f"hydra.searchpath=[file://{EXAMPLES / name}]", *words), folder)
    return folder


def test_own_planner(example):
    ours = example("evaluate", "own_planner", "planner=soft_dbl", "planner.seed=1", *EVALUATION)
    assert ours["planner"] == "soft_dbl" and set(ours["failures"]) == {"stuck"} and ours["occupancy"]["mean"] > 0.8
    assert ours["planner_settings"] == {"temperature": 0.05, "seed": 1}


def test_own_engine(example, monkeypatch):
    ours = example("evaluate", "own_engine", "planner=joint_dbl", "physics=load_limit", *EVALUATION)
    found = ours["physics"]
    assert (found["method"], found["settings"]["max_load"]) == ("load_limit", 0.2)
    assert found["endings"]["crushed"] and found["occupancy"]["mean"] < ours["occupancy"]["mean"]
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_engine"))
    engine = importlib.import_module("own_engine").LoadLimit(max_load=0.08)
    tower = [Placement((0.0, 0.0, 0.05 * level), (0.05, 0.05, 0.05)) for level in range(4)]  # of 37.5 g each
    (outcome,) = engine.carry_out([EpisodePlan(0, (0.1, 0.1, 0.2), placements=tower)])
    assert (outcome.ending, outcome.lost, outcome.during, outcome.occupancy) == ("crushed", 0, 3, pytest.approx(3 / 16))


def test_own_planner_draws_by_its_seed(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_planner"))
    env = PickPlaceEnv(num_envs=32)
    make = importlib.import_module("own_planner").SoftDBL
    first, same, other = (make(env.cell, temperature=1.0, seed=seed) for seed in (3, 3, 4))
    for _ in range(3):
        observation = env.reset()
        action = first.decide(observation)
        assert torch.equal(action, same.decide(observation)) and not torch.equal(action, other.decide(observation))


@pytest.mark.slow
def test_own_planner_teaches(example, tmp_path):
    """A training that is resumed while it imitates draws the same numbers as an uninterrupted one."""
    imitate = ["warm_start=imitate", "planner@warm_start.teacher=soft_dbl", "warm_start.teacher.temperature=1"]
    imitate += ["warm_start.frames=128", "warm_start.critic_frames=64", "curriculum=none", "algo.lr_decay_start=null"]
    imitate += ["model.actor.filters=8"]
    whole = trained("own_planner", tmp_path / "whole", *imitate, *TRAINING, "total_frames=256")
    folder = trained("own_planner", tmp_path / "part", *imitate, *TRAINING)
    resume = [f"resume={folder}", "total_frames=256"]
    example("train", "own_planner", *resume, refused="if own_planner is yours, say trust=own_planner")
    example("train", "own_planner", *resume, "trust=own_planner")
    states = [checkpoint.read(locate(place, prefer="last"))[0]["policy"] for place in (whole, folder)]
    assert all(torch.equal(value, states[1][key]) for key, value in states[0].items())
    ours = example("evaluate", "own_planner", f"checkpoint={folder}", *EVALUATION)
    assert ours["warm_start"] == "own_planner.SoftDBL" and ours["planner"] == "policy"


def test_own_model_is_trusted_by_name_and_each_time(example, capsys, tmp_path):
    folder = example("train", "own_model", "model=mlp", "model.actor.hidden=8", "trust=own_model", *TRAINING)
    resume = [f"resume={folder}", "total_frames=128"]
    imitate = ["warm_start=imitate", "planner@warm_start.teacher=policy", "warm_start.frames=64"]
    taught = [*imitate, f"warm_start.checkpoint={folder}", *TRAINING]
    said = "'own_model.Mlp': the checkpoint is refused"
    example("train", "own_model", *resume, refused=said)
    with pytest.raises(ValueError, match=r"if own_model is yours, say trust=own_model"):
        trained("own_model", tmp_path / "refused", *taught)
    example("evaluate", "own_model", f"checkpoint={folder}", "trust=[own_models,model]", refused=said)
    with pytest.raises(ValueError, match=r"own_model\.Mlp"):
        Planner.load(folder)

    example("train", "own_model", *resume, "trust=[own_model]")
    assert checkpoint.read(locate(folder, prefer="last"))[1]["frames"] == 128
    trained("own_model", tmp_path / "taught", *taught, "trust=own_model")
    ours = example("evaluate", "own_model", f"checkpoint={folder}", "trust=own_model", *EVALUATION)
    assert ours["planner"] == "policy" and set(ours["failures"]) == {"stuck"}
    assert Planner.load(folder, trust=["own_model"]).plan(Scene.from_maps(BIN, TOTE)).status == "ok"
    np.save(tmp_path / "bin.npy", BIN)
    np.save(tmp_path / "tote.npy", TOTE)
    maps = ["--bin", str(tmp_path / "bin.npy"), "--tote", str(tmp_path / "tote.npy")]
    json_lines.run(json_lines.parser().parse_args([str(folder), *maps, "--trust", "own_model"]))
    assert '"status": "ok"' in capsys.readouterr().out


def test_own_observation(example, tmp_path):
    """A term and a policy that reads it: imitated, trained, evaluated, searched and planned with."""
    words = ["env=pits", "model=pit_policy", "model.actor.filters=8", "curriculum=none", "env.tote_size=[6,6,2]"]
    words += ["warm_start=imitate", "warm_start.frames=64", "warm_start.critic_frames=64", "total_frames=192"]
    folder = trained("own_observation", tmp_path / "run", *TRAINING, *words)
    weights = checkpoint.read(locate(folder, prefer="last"))[0]["policy"]
    given = [f"checkpoint={folder}", "trust=own_observation", *EVALUATION]
    for planner in (["planner=lookahead", "planner.samples=2", "planner.candidates=2", "evaluation.episodes=1"], []):
        ours = example("evaluate", "own_observation", *given, *planner)
        assert list(ours["env"]["observation"]) == [*STANDARD_TERMS, "pit_depth"]
    assert ours["occupancy"]["mean"] > 0.2 and any("pits" in name for name in weights)
    for load in (Planner.load, load_policy):
        with pytest.raises(ValueError, match=r"own_observation\.P"):
            load(folder)
    policy = load_policy(folder, trust=["own_observation"])
    assert "pit_depth" in policy.in_keys and policy.make_env(num_envs=2).rollout(20, policy).shape[1] > 2
    scene = Scene.from_maps(BIN, np.full((6, 6), 2))
    assert Planner.load(folder, trust=["own_observation"]).plan(scene).status == "ok"


def test_own_support(example, tmp_path):
    """A stability rule: trained, evaluated, settled, searched and planned with."""
    small = ["model.actor.filters=8", "env.tote_size=[5,5,4]", "curriculum=none", "items=mixed"]
    folder = trained("own_support", tmp_path / "run", "support=corners_or_hull", *TRAINING, *small)
    given = [f"checkpoint={folder}", *EVALUATION]
    example("evaluate", "own_support", *given, refused="if own_support is yours, say trust=own_support")
    given += ["trust=own_support"]
    ours = example("evaluate", "own_support", *given, "physics=settle")
    assert ours["env"]["support"] == {"_target_": "own_support.CornersOrHull", "corners": 3, "share": 0.6}
    assert ours["physics"]["method"] == "settle"
    stricter = example("evaluate", "own_support", *given, "env.support.corners=4", "planner=joint_dbl")
    assert stricter["env"]["support"]["corners"] == 4
    planner = Planner.load(folder, trust=["own_support"])
    assert type(planner.cell.support).__name__ == "CornersOrHull"
    tote = np.full((5, 5), 0.2)
    tote[:2] = 0.15  # there are items
    plan = planner.plan(Scene([Box(0.1, 0.1, 0.09, 0.09, 0.05)], tote, cell_size=0.05))
    assert plan.status == "ok"


def test_own_gripper(example, tmp_path):
    """A grip rule: trained, evaluated with other settings, and planned with in metres."""
    small = ["model.actor.filters=8", "curriculum=none"]
    folder = trained("own_gripper", tmp_path / "run", "gripper=two_cells", *TRAINING, *small)
    given = [f"checkpoint={folder}", *EVALUATION]
    example("evaluate", "own_gripper", *given, refused="if own_gripper is yours, say trust=own_gripper")
    ours = example("evaluate", "own_gripper", *given, "trust=own_gripper", "env.gripper.cells=1")
    assert ours["env"]["gripper"]["_target_"] == "own_gripper.TwoCells" and ours["env"]["gripper"]["cells"] == 1
    planner = Planner.load(folder, trust=["own_gripper"])
    assert type(planner.cell.gripper).__name__ == "TwoCells"
    wide = Box(0.12, 0.12, 0.14, 0.14, 0.05)  # along each side, one of three cells is surely covered
    plan = planner.plan(Scene([wide], np.full((6, 6), 0.25), cell_size=0.05))
    assert plan.status == "ok"


ALGORITHMS = {
    "own_algorithm_ppo": ["algo=ppo_entropy"],
    "own_algorithm_reinforce": ["algo=reinforce"],
    "own_algorithm_dqn": ["algo=dqn", "model.critic=null", "algo.capacity=100", "algo.minibatch_size=16"],
}
SMALL = ["model.actor.filters=8", "env.tote_size=[4,4,2]", "curriculum=mixture", "total_frames=320", *TRAINING[:1]]
SMALL += ["evaluation_interval=128", "evaluation.episodes=2", "threads=1", "seed=3"]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_own_algorithm(name, example, tmp_path):
    """Trained, stopped and resumed exactly, and evaluated; the evaluation needs no trust in the algorithm."""
    words = [*ALGORITHMS[name], *SMALL]
    whole, folder = trained(name, tmp_path / "whole", *words), tmp_path / "part"
    with after_batch(3, lambda _: signal.raise_signal(signal.SIGTERM)), pytest.raises(KeyboardInterrupt):
        trained(name, folder, *words)
    assert checkpoint.read(locate(folder, prefer="last"))[1]["frames"] == 192
    example("train", name, f"resume={folder}", refused=f"if {name} is yours, say trust={name}")
    example("train", name, f"resume={folder}", f"trust={name}")
    assert_same(whole, folder)
    rows = read_csv(folder / "metrics.csv")
    if name == "own_algorithm_ppo":
        assert [row["train/entropy_coeff"] for row in rows] == pytest.approx([0.02, 0.016, 0.012, 0.008, 0.004])
    assert len({row.get("train/loss_objective", row.get("train/loss")) for row in rows}) == 5
    ours = example("evaluate", name, f"checkpoint={folder}", *EVALUATION)
    assert ours["planner"] == "policy" and ours["mask_in_training"] is True


@pytest.mark.parametrize(("path", "value", "words"), [
    ("cursor", 100, "100 frames and a cursor at 100"), ("cursor", -1, "a cursor at -1"),
    ("cursor", None, "cursor is missing"), ("epsilon", torch.tensor(7.0), "epsilon=7.0: expected a number between"),
    ("frames|footprint", torch.full((100,), 9999), "choices that are not below"),
    ("frames|footprint", torch.zeros(200, dtype=torch.int64), "of shape (100, 5, 5)"),
    ("frames|next|reward", torch.full((100, 1), torch.nan), "not finite"), ("frames|next|done", None, "is missing"),
    ("target", {}, "is missing"), ("optimizer", {99: {}}, "optimizer has 99"),
])  # fmt: skip
def test_a_replay_buffer_that_no_training_wrote_is_refused(path, value, words, example, dqn_run, tmp_path):
    folder = shutil.copytree(dqn_run, tmp_path / "copy")
    state, facts = checkpoint.read(folder / "checkpoints" / "last")
    node, (*parents, leaf) = state["algorithm"], path.split("|")
    for parent in parents:
        node = node[parent]
    node[leaf] = value
    if value is None:
        del node[leaf]
    del facts["schema"], facts["sha256"]
    checkpoint.write(folder / "checkpoints" / "last", state, facts)
    resume = [f"resume={folder}", "total_frames=256", "trust=own_algorithm_dqn"]
    example("train", "own_algorithm_dqn", *resume, refused=words)


@pytest.fixture(scope="module")
def dqn_run(tmp_path_factory):
    """A run of the example of DQN whose replay buffer is full."""
    words = [*ALGORITHMS["own_algorithm_dqn"], *SMALL, "total_frames=128", "logger=none"]
    return trained("own_algorithm_dqn", tmp_path_factory.mktemp("dqn") / "run", *words)


def test_dqn_learns_a_mask_and_a_number_by_hand(monkeypatch):
    """The value of a choice approaches its reward where nothing follows; choices that the mask forbids have none."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "own_algorithm_dqn"))
    env = PickPlaceEnv(num_envs=8, tote_size=(3, 3, 1), masks=("footprint",))
    policy = FcnGrasp(env.cell, filters=8, hidden=8)
    task = Task(STANDARD_TERMS, env.observation_spec.zero()[:1], 0.5, num_envs=8, rollout_length=4)
    words = {"capacity": 512, "minibatch_size": 64, "updates": 32, "lr": 1e-2, "gamma": 0.0, "tau": 0.1}
    dqn = importlib.import_module("own_algorithm_dqn").DQN(policy, None, task, **words, epsilon=0.5, decay=0.5)
    torch.manual_seed(0)
    for iteration in range(8):
        with torch.no_grad():
            batch = env.rollout(4, dqn.acting_policy(), break_when_any_done=False)
        for key in ("footprint_mask",):
            assert batch[key].flatten(2).gather(2, batch["footprint"][..., None]).all()
        metrics = dqn.learn(batch, BatchPosition(32 * iteration, 32 * iteration + 32, iteration + 1, 256))
    assert metrics["train/epsilon"] == 0.5 and metrics["train/loss"] < 0.05
    with torch.no_grad():
        value = policy.logits(batch.reshape(-1)).gather(1, batch["footprint"].reshape(-1, 1))
    torch.testing.assert_close(value, batch["next", "reward"].reshape(-1, 1), rtol=0, atol=0.4)


def test_own_items(example, tmp_path):
    small = ["model.actor.filters=8", "env.tote_size=[4,4,2]"]
    folder = trained("own_items", tmp_path / "run", "items=batches", *TRAINING, *small)
    ours = example("evaluate", "own_items", f"checkpoint={folder}", "trust=own_items", *EVALUATION)
    assert ours["items"]["run"] == 3 and ours["env"]["tote_size"] == [4, 4, 2]


def test_own_benchmark(example):
    ours = example("evaluate", "own_benchmark", "benchmark=small_boxes", "planner=joint_dbl", *EVALUATION)
    assert ours["env"]["tote_size"] == [8, 8, 8] and ours["items"]["height"] == [1, 3]
    assert ours["occupancy"]["mean"] > 0.5


def test_recorded_items(example):
    ours = example("evaluate", "recorded_items", "items=morning", "planner=joint_dbl", *EVALUATION)
    assert ours["items"]["loop"] is True and ours["occupancy"]["mean"] > 0.8


def test_orders(example):
    path = f"items.path={EXAMPLES}/orders/orders.csv"
    ours = example(
        "evaluate", "orders", "items=orders", path, "planner=joint_dbl", *EVALUATION, "evaluation.episodes=1"
    )
    assert ours["items"]["cell_size"] == 0.05
    assert ours["share_placed"]["mean"] == 1
    assert 0.05 < ours["true_occupancy"]["mean"] < ours["occupancy"]["mean"]


@pytest.mark.parametrize(("name", "levels"), [("ramp", [2, 3, 3, 3, 4]), ("careful", [3, 4, 3, 4, 4])])
def test_own_curriculum(name, levels):
    search = f"hydra.searchpath=[file://{EXAMPLES / 'own_curriculum'}]"
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        curriculum = build("curriculum", compose("train", [search, f"curriculum={name}"]).curriculum)
    curriculum.setup(CellSpec(tote_size=(6, 6, 4)), Kinds([(1, 1, 1)]), 400_000)
    assert (curriculum.level, curriculum.end) == (2, 4) and curriculum.check_budget(400_000) is None
    seen = []
    for frames in range(0, 200_001, 50_000):
        occupancy = torch.full((200,), 0.45 if frames == 100_000 else 0.9)
        curriculum.update(torch.full((200,), curriculum.level), occupancy, frames)
        seen.append(curriculum.level)
    assert seen == levels


def test_own_advance(example, tmp_path):
    """The rule draws the levels; a resumed training equals an uninterrupted one."""
    words = ["curriculum/advance=worst_first", "curriculum.advance.keep=0.5", "algo.lr_decay_start=null", *TRAINING]
    words += ["model.actor.filters=8", "logger=csv"]
    whole = trained("own_advance", tmp_path / "whole", *words, "total_frames=256")
    folder = trained("own_advance", tmp_path / "part", *words)
    example("train", "own_advance", f"resume={folder}", "total_frames=256", "trust=own_advance")
    ours, theirs = (checkpoint.read(locate(place, "last")) for place in (whole, folder))
    assert all(torch.equal(value, theirs[0]["policy"][key]) for key, value in ours[0]["policy"].items())
    assert ours[1]["curriculum"] == theirs[1]["curriculum"]
    saved = ours[1]["curriculum"]["advance"]["occupancy"]
    rows = read_csv(whole / "metrics.csv")
    assert len(saved) == 5 and min(saved.values()) == rows[-1]["curriculum/worst"]
    assert len({row["curriculum/level"] for row in rows}) > 1


@pytest.mark.parametrize(("total_frames", "gain"), [(1_024, -0.1), pytest.param(6_144, 0.03, marks=pytest.mark.slow)])
def test_torchrl_ppo(monkeypatch, total_frames, gain):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    before, after = importlib.import_module("torchrl_ppo").train(total_frames=total_frames)
    assert 0.7 < before < 1 and before + gain < after < 1


class FakeStudy:
    """A substitute for Optuna's study, which proposes these learning rates and stores the results."""

    def __init__(self, *rates):
        self.rates, self.told = rates, []

    def ask(self):
        number = len(self.told)
        return SimpleNamespace(
            number=number,
            suggest_float=lambda key, low, high, log: self.rates[number],
            suggest_categorical=lambda key, choices: max(choices),
        )

    def tell(self, trial, value):
        self.told.append(value)


def test_a_search_with_optuna_leaves_the_tables_of_a_sweep(monkeypatch, tmp_path, no_report):
    """Uses a substitute for Optuna; the next test uses Optuna itself."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    search, study = importlib.import_module("optuna_search").search, FakeStudy(1e-3, -1.0)
    search(study, tmp_path, 2, [*TRAINING, "curriculum=none", "model.actor.filters=8"])
    with open(tmp_path / "sweep.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["finished", "failed"] and rows[1]["algo.epochs"] == "4"
    assert float(rows[0]["final_occupancy"]) == study.told[0] and math.isnan(study.told[1])
    assert (tmp_path / "sweep.png").is_file() and "algo.lr=-1.0" in rows[1]["error"]


def test_a_search_with_optuna(monkeypatch, tmp_path, no_report):
    optuna = pytest.importorskip("optuna", "4")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    study = optuna.create_study(direction="maximize")
    importlib.import_module("optuna_search").search(study, tmp_path, 2, [*TRAINING, "model.actor.filters=8"])
    assert len(study.trials) == 2 and study.best_params["algo.epochs"] in (1, 2, 4)


NOTEBOOK = EXAMPLES / "quickstart.ipynb"


def assert_shown(notebook):
    """Check that a notebook shows a curve, a replay, and the result of the training."""
    shown = [output["data"] for cell in notebook.cells for output in cell.get("outputs", [])]
    assert [kind for data in shown for kind in data if "image" in kind] == ["image/png", "image/gif"]
    means = ast.literal_eval(shown[1]["text/plain"])
    assert means["random"] < 0.5 < 0.9 < means["policy"] and float(shown[0]["text/plain"]) > 0.9


def test_quickstart_notebook(monkeypatch, no_report, tmp_path):
    """The committed outputs are there. The cells run from top to bottom, without Jupyter and with a short training."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert_shown(notebook)
    assert NOTEBOOK.stat().st_size < 300_000
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    small = '"threads=1", "env.num_envs=32", "evaluation.episodes=16"'
    smaller = {"30_000": "4_096", "5_000": "2_048", '"threads=1"': small, "frames=12": "frames=2"}
    for long, short in smaller.items():
        assert code.count(long) == 1
        code = code.replace(long, short)
    names = {}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    exec(compile(code, NOTEBOOK.name, "exec"), names)
    lines = {line.get_label(): line for line in names["axes"].lines}
    assert [*lines] == ["train/occupancy", "eval/occupancy", "joint_dbl", "random"]
    assert len(lines["eval/occupancy"].get_xdata()) == 2 and (names["run_dir"] / "replay.gif").is_file()
    assert names["means"]["random"] < 0.5 < 0.9 < names["means"]["policy"]
    names["plt"].close(names["figure"])


def test_robot_notebook(monkeypatch):
    """The committed outputs are there, and the cells run from top to bottom."""
    notebook = nbformat.read(EXAMPLES / "robot.ipynb", as_version=4)
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in data for data in shown) == 3
    pytest.importorskip("mujoco")
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert code.count("range(1, 9)") == 1
    names = {}
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    exec(compile(code.replace("range(1, 9)", "range(1, 3)"), "robot.ipynb", "exec"), names)
    assert names["plan"].status == "ok" and len(names["placed"]) == 2
    names["plt"].close("all")


@pytest.mark.slow
def test_quickstart_notebook_in_jupyter(tmp_path):
    """The notebook runs unchanged in Jupyter, and shows its results."""
    executed = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(executed, timeout=300, kernel_name="python3").execute(cwd=tmp_path)
    assert_shown(executed)


def test_an_order_list_becomes_picks_and_places(capsys):
    """The items lie apart in the tote; one that cannot be picked is named, and the next one is planned."""
    script = runpy.run_path(str(EXAMPLES / "order_to_robot.py"))
    planner = Planner.load("pretrained/warehouse", tote_size=(20, 15, 30), **script["CUP"])
    sides = [(90, 60, 140), (62, 48, 30), (140, 90, 45), (320, 90, 45), (120, 100, 100), (95, 60, 80)]
    items = [OrderItem(str(n), *map(float, each), 500, f"line {n}") for n, each in enumerate(sides)]
    plans = [plan for _, plan in script["plan_order"](planner, items)]
    rows = [script["row_of"]("7", *each) for each in zip(items, plans, strict=True)]
    assert [row["status"] for row in rows] == ["ok", "impossible", "ok", "refused", "ok", "ok"]
    assert "items[0]: the cup does not fit" in rows[1]["reason"] and "expected" in str(rows[3]["reason"])
    row = rows[0]
    assert row["pick_z/mm"] == 143 and row["place_z/mm"] == 146 and row["fill"] == "4.2%"
    boxes = []
    for row, plan in zip(rows, plans, strict=True):
        if row["status"] == "ok":
            at = plan.placed
            low = np.array([at.x - at.w / 2, at.y - at.d / 2, plan.drop_height])
            high = np.array([at.x + at.w / 2, at.y + at.d / 2, at.h])
            assert (low >= 0).all() and (high <= (0.4, 0.3, 0.15)).all()
            boxes.append((low, high))
    for (low, high), (other_low, other_high) in itertools.combinations(boxes, 2):
        assert (np.minimum(high, other_high) - np.maximum(low, other_low)).min() <= 1e-9
    script["main"](EXAMPLES / "orders" / "orders.csv")
    printed = [*csv.DictReader(capsys.readouterr().out.splitlines())]
    assert len(printed) == 39 and {row["status"] for row in printed} == {"ok", "impossible"}
