"""The commands: bad input ends in one sentence, a code other than 0, and leaves nothing behind."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import composed
from omegaconf import OmegaConf

import pickplace
from pickplace.common.errors import full_names, sentence
from pickplace.config.composition import apply_overrides, compose_plain, compose_training, known_names
from pickplace.config.help import GROUPS
from pickplace.config.words import conf_dir
from pickplace.evaluation import evaluate
from pickplace.evaluation.evaluate import prepare
from pickplace.runs.folder import noted_command
from pickplace.training import train
from pickplace.training.settings import check_settings
from pickplace.training.trainer import Trainer

EXAMPLES = Path(__file__).parents[2] / "docs/examples"
CURRICULA = EXAMPLES / "own_curriculum"
PLATEAU = {"_target_": "plateau", "window": 400, "patience": 3, "min_improvement": 0.01}
MINE = """\
# @package _global_
defaults: [{override /curriculum: adaptive}, {override /callbacks: early_stopping}, _self_]
callbacks: {early_stopping: {patience: 3}}
curriculum: {advance: {window: 7, occupancy: 0.5}}
items: {kinds: [[1, 1, 1]]}
algo: {lr: 0.5}
"""

WIDE = """\
# @package _global_
defaults: [{override /model: fcn4d}, {override /items: mixed}, {override /callbacks: [early_stopping]}, _self_]
model: {actor: {filters: 7}}
items: {width: [1, 1]}
callbacks: {early_stopping: {patience: 5}}
"""
FAR = """\
# @package _global_
defaults: [{override /reach: annulus}, _self_]
env: {reach: {radii: [0, 50]}}
"""
OWN_CELL = """\
defaults: [stable, _self_]
reach: {_target_: annulus, radii: [0, 20], heights: [0, 9], bin: [-9, 0, 0], tote: [2, 0, 0]}
"""
SLOW = """\
defaults: [{advance: frames}, {sample: current}, _self_]
_target_: curriculum
start_height: null
end_height: null
advance: {frames_per_level: 50_000}
"""

#: Command, its words, and parts of the sentence: a sample of each kind; tests of the parts hold the others.
BAD = [
    # keys and values that Hydra or the config does not know
    ("train", "algo.gama=0.9", ["algo.gama", "'gamma'"]),
    ("train", "+env.foo=1", ["env.foo", "no key 'foo'"]),
    ("train", "~curriculum.levels", ["curriculum.levels: it is null already"]),
    ("train", "algo.gama=0.9 --help", ["algo.gama", "'gamma'"]),
    ("train", "--config-dir nowhere", ["nowhere"]),
    ("train", "algo.gamma=1.5 --config-dir . seed=2", ["algo.gamma=1.5", "between 0 and 1"]),  # flags between overrides
    ("train", "seed=1 -m algo.gamma=1.5,2", ["algo.gamma=1.5"]),
    ("train", "--seed 1", ["--seed: there is no such flag", "expected seed=1."]),
    ("train", "-m -experiment=quick", ["expected experiment=quick."]),
    ("train", "--rotations --help", ["expected env.rotations=<value>."]),
    ("evaluate", "--config_dir nowhere", ["--config_dir", "expected --config-dir."]),
    ("train", "curriculum/sampler=recent", ["curriculum/sampler", "did you mean 'curriculum/sample'?"]),
    ("train", "experimet=quick", ["experimet", "did you mean 'experiment'?"]),
    ("train", "seed=3 +rotations=2", ["rotations", "did you mean 'env.rotations'?"]),
    ("train", "~algo.gama", ["algo.gama", "'gamma'"]),
    ("train", "curriculum.sample=recent", ["curriculum.sample='recent'", "expected curriculum/sample=recent."]),
    ("train", "env/gripper=round", ["env/gripper='round'", "gripper=<one of cup_array, "]),
    ("evaluate", "planner=joint_dbl env.rotatoins=2", ["env.rotatoins", "'rotations'"]),
    ("train", "+model.actor.foo=1", ["model.actor.foo", "expected one of filters, receptive_field, "]),
    ("train", "algo.lr=${algo.lr}", ["algo.lr: ", "interpolation"]),
    ("evaluate", "planner=[[1,2],[3]]", ["planner=[[1,2],[3]]"]),
    ("evaluate", "--cfg foo", ["--cfg", "'foo'", "job"]),
    ("train", "env.tote_size=[6,6", ["'env.tote_size=[6,6'", "<key>=<value>"]),
    ("train", "seed=1,2", ["seed=1,2: several values; expected one, or the command with -m"]),
    ("train", "-m hydra.run.dir=x", ["hydra.run.dir=x: this is a sweep; expected hydra.sweep.dir=<folder>."]),
    ("train", "hydra.sweep.dir=x", ["hydra.sweep.dir=x: this is a run; expected hydra.run.dir=<folder>."]),
    ("train", "curriculum=null", ["curriculum=null", "adaptive", "paper"]),
    ("train", "curriculum.advance=foo", ["curriculum.advance='foo'", "curriculum/advance=<one of frames, "]),
    ("train", "planner=random", ["planner._target_='random'", "expected policy"]),
    # sweeps, before their first run
    ("train", "-m algo.gama=0.9,1", ["algo.gama", "'gamma'"]),
    ("train", "-m curriculum=none,mien", ["curriculum/mien", "adaptive"]),
    # cells and items
    ("train", "items=recorded", ["items.path", "no value"]),
    ("train", "reach=table", ["env.reach.path", "no value"]),
    ("train", "env.reach.radii=[1,2]", ["env.reach.radii: env.reach is null", "an option that"]),
    ("train", "reach=annulus env.reach.radi=[1,2]", ["env.reach.radi", "'radii'"]),
    ("train", "model=afterstate model.critic.filters=8 model.critic.hidden=8", ["model.critic is null, without keys"]),
    ("evaluate", "planner=joint_dbl env.reach.radii=[1,2]", ["env.reach.radii: env.reach is null", "an option that"]),
    # resume
    ("train", "resume=nowhere", ["nowhere'", "run folder"]),
    ("train", "resume=nowhere -m", ["-m: a resumed run keeps", "a new run with warm_start.weights=nowhere"]),
    ("train", "resume=nowhere hydra.run.dir=x", ["hydra.run.dir=x: a resumed run keeps its folder"]),
    ("train", "++resume=nowhere", ["resume='nowhere'", "without a +"]),
    # evaluation
    ("evaluate", "", ["checkpoint=null", "run folder"]),
    ("evaluate", "checkpoint=nowhere", ["nowhere'", "run folder"]),
    ("evaluate", "planner=joint_dbl model.actor.filters=8", ["model", "checkpoint=<run folder>"]),
    ("evaluate", "planner=joint_dbl compare=nowhere.json", ["compare='nowhere.json'", "evaluation.json"]),
    ("evaluate", "planner=joint_dbl items.widht=1", ["items.widht", "no key 'widht'", "'weights'"]),
    ("evaluate", "checkpoint=pretrained/mixed items.kinds=[[1,1,1]]", ["items.kinds", "width, depth, height"]),
]

#: The same for values that the command hands on; for those of every setting see test_bad_settings.
BAD_VALUES = [
    ("train", "+collector.foo=1", ["collector.foo", "in collector; expected no key."]),
    ("train", "env.observation.bin_depth={_target_:tote_depth}", ["bin_depth=ToteDepth: expected BinDepth"]),
    ("train", "env.reach=far", ["reach='far'", "expected a Reach"]),
    ("train", "model.actor._target_=fcn", ["model.actor._target_=fcn", "'fcn4d'"]),
    ("train", "model.actor._target_=os.system", ["model.actor", "command"]),
    ("train", "trust=[os]", ["trust='os'", "modules of your own"]),
    ("train", "env.tote_size=[6,6,-5]", ["tote_size=[6, 6, -5]", "3 whole numbers >= 1"]),
    ("train", "env.tote_size=[5,5,3000000000]", ["3000000000", "<= 2,000"]),
    ("train", "items.kinds=[[1,1,9]]", ["item 1x1x9", "tote_size[2]=5"]),
    ("train", "items=recorded items.path=nowhere.csv", ["items.path='nowhere.csv'", "no such file"]),
    ("train", "reach=table env.reach.path=nowhere.csv", ["reach.path='nowhere.csv'", "no such file"]),
    ("train", "reach=annulus env.reach.radii=[0,4]", ["item 1x1x1 at x=0, y=0", "reach=Annulus(radii=(0.0, 4.0)"]),
    ("train", "reach=annulus env.reach.radii=[4,0]", ["reach.radii=[4.0, 0.0]", "least <= greatest"]),
    ("train", "model=fcn4d env.tote_size=[4,4,1]", ["tote_size=[4, 4, 1]", "eq. 3"]),
    ("train", "curriculum.start_height=9", ["start_height=9"]),
    (
        "train",
        "experiment=smoke warm_start=imitate planner@warm_start.teacher=mcts warm_start.teacher.simulations=100000000",
        ["warm_start.teacher.simulations=100000000", "<= "],
    ),
    ("train", "collector=multi_sync collector.workers=3", ["collector.workers=3", "divisor"]),
    ("train", "algo=a2c env.num_envs=1 rollout_length=1", ["algo.normalize_advantage=True", "one frame"]),
    (
        "train",
        "algo=sampled_ppo algo.advantages=gae env.num_envs=1 rollout_length=1",
        ["algo.normalize_advantage=True", "one frame"],
    ),
    ("evaluate", "planner=joint_dbl evaluation.stream=exam", ["evaluation.stream='exam'", "'validation'"]),
    ("evaluate", "planner=joint_dbl evaluation.latency_decisions=x", ["latency_decisions='x'", ">= 0"]),
    ("train", "threads=10000000000", ["threads=10000000000", "<= 1"]),
    ("train", "device=tpu", ["device=tpu", "cpu"]),
    ("train", "algo._target_=dqn", ["algo._target_=dqn", "expected one of ppo, a2c, sampled_ppo, td"]),
    ("train", "evaluation.stream=test", ["evaluation.stream='test'", "validation"]),
]


#: Words of the command line, and parts of the resulting config by their keys.
OWN_VALUES = [
    # a config file of the user's, written for threshold
    ("curriculum=careful curriculum/advance=plateau curriculum.advance.window=9", {"curriculum.advance.window": 9}),
    ("curriculum=careful curriculum/advance=threshold", {"curriculum.advance.window": 200}),
    ("curriculum=careful", {"curriculum.advance.window": 200}),
    # presets
    ("experiment=smoke model=fcn4d", {"model.actor.filters": 64, "model.critic.hidden": 256}),
    ("experiment=smoke model=fcn4d model.actor={filters:4}", {"model.actor.filters": 4}),
    ("experiment=smoke model=fcn_grasp", {"model.actor.filters": 8}),
    ("experiment=smoke env=deep_bin", {"env.tote_size": [4, 4, 1]}),
    ("experiment=mixed_grasp warm_start=none", {"warm_start.frames": 0}),
    ("experiment=mixed_grasp planner@warm_start.teacher=mcts", {"warm_start.frames": 100_000}),
    ("experiment=mine", {"curriculum.advance.window": 7}),
    # other options with the same _target_
    ("experiment=mine curriculum=mixture", {"curriculum.advance.window": 400}),
    ("experiment=mine curriculum=mixture curriculum.advance.window=9", {"curriculum.advance.window": 9}),
    ("curriculum=slow curriculum/advance=paper", {"curriculum.advance.frames_per_level": 5_000_000}),
    ("curriculum=slow curriculum/advance=frames", {"curriculum.advance.frames_per_level": 50_000}),
    ("experiment=smoke model=individual_grasp", {"model.critic.filters": 32}),
    ("experiment=wide model=fcn4d_noclip", {"model.actor.filters": 64}),
    ("experiment=wide model=fcn4d", {"model.actor.filters": 7}),
    ("experiment=wide items=tall", {"items.width": [1, 2]}),
    ("experiment=wide items=mixed", {"items.width": [1, 1]}),
    ("experiment=wide callbacks=[early_stopping]", {"callbacks.early_stopping.patience": 5}),
    ("experiment=wide callbacks=[second]", {"callbacks": {"second": {"_target_": "early_stopping", "patience": 2}}}),
    ("experiment=wide callbacks=[second] callbacks.second.patience=7", {"callbacks.second.patience": 7}),
    ("experiment=wide callbacks=[second,early_stopping]", {"callbacks.early_stopping.patience": 5}),
    ("experiment=wide callbacks=[]", {"callbacks": {}}),
    ("curriculum=careful curriculum.sample.share='${..advance.occupancy}'", {"curriculum.sample.share": 0.85}),
    ("experiment=mine curriculum/advance=plateau", {"curriculum.advance": PLATEAU}),
    ("experiment=mine curriculum=paper", {"curriculum.advance": {"_target_": "frames", "frames_per_level": 5_000_000}}),
    ("experiment=mine curriculum=careful curriculum/advance=plateau", {"curriculum.advance": PLATEAU}),
    ("experiment=mine items=tall", {"items.kinds": None}),
    ("experiment=mine algo=a2c", {"algo.lr": 0.5}),
    ("experiment=mine callbacks=early_stopping", {"callbacks.early_stopping.patience": 3}),
    # of two choices for a group, the last one
    ("curriculum=mixture curriculum=none", {"curriculum.advance": {"_target_": "none"}}),
    ("algo=a2c algo=td model=afterstate", {"algo._target_": "td", "algo.entropy_coeff": None}),
    ("items=mixed items=boxes", {"items._target_": "uniform"}),
    ("gripper=plate_5x5 gripper=point", {"env.gripper.size": [1, 1]}),
    ("support=half support=hull", {"env.support._target_": "hull"}),
    # groups that set a part of env
    ("experiment=smoke", {"env.reach": None}),
    ("experiment=far", {"env.reach.radii": [0, 50]}),
    ("experiment=far reach=annulus", {"env.reach.radii": [0, 50]}),
    ("experiment=far reach=annulus env.reach.radii=[1,2]", {"env.reach.radii": [1, 2]}),
    ("experiment=far reach=table env.reach.path=a.csv", {"env.reach": {"_target_": "table", "path": "a.csv"}}),
    ("env=own_cell", {"env.reach.radii": [0, 20]}),
    ("env=own_cell env.reach.radii=[1,2]", {"env.reach.radii": [1, 2]}),
    ("env=own_cell reach=everywhere", {"env.reach": None}),
    ("env=own_cell reach=annulus", {"env.reach.radii": [4.6, 9.6]}),
    ("reach=annulus env.reach.radii=[1,2] env.tote_size=[7,7,5]", {"env.reach.radii": [1, 2]}),
    ("experiment=mine ~curriculum.advance.window curriculum/advance=plateau", {"curriculum.advance.window": None}),
]


GOPT, CUT = {"env.tote_size": [10, 10, 10], "env.bin_size": [5, 5, 1], "env.gripper.size": [1, 1]}, "items.drawn.order"
OF_BENCHMARKS = [
    ("experiment=mixed benchmark=gopt_rs", GOPT | {"items.width": [1, 5], "env.support": "half_or_hull"}),
    ("experiment=warehouse benchmark=gopt_rs", GOPT | {"env.height_unit": 1.0, "env.num_envs": 64}),
    ("experiment=mixed benchmark=cut1", GOPT | {CUT: "z", "items.width": None, "env.rotations": 1}),
    ("experiment=mixed_grasp benchmark=cut1 items.drawn.order=stacking", {CUT: "stacking", "env.rotations": 1}),
    ("experiment=mixed benchmark=gopt_rs items=kinds", GOPT | {"items.width": None, "items._target_": "kinds"}),
    ("experiment=mixed benchmark=gopt_rs env.tote_size=[8,8,9] items.width=[1,3] gripper=plate_3x3",
     {"env.tote_size": [8, 8, 9], "items.width": [1, 3], "items.depth": [1, 5], "env.gripper.size": [3, 3]}),
    ("experiment=buffer benchmark=cut1", {"env.bin_size": [20, 20, 1], "env.bin_items": 10, CUT: "z"}),
]  # fmt: skip


@pytest.fixture
def search(tmp_path):
    """Returns the override that adds folders with config files of the user's."""
    files = {"experiment/mine": MINE, "experiment/wide": WIDE, "experiment/far": FAR}
    files |= {"callbacks/second": "second: {_target_: early_stopping, patience: 2}\n", "curriculum/slow": SLOW}
    for name, text in {**files, "env/own_cell": OWN_CELL}.items():
        (tmp_path / "conf" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "conf" / f"{name}.yaml").write_text(text)
    return f"hydra.searchpath=[file://{tmp_path}/conf,file://{CURRICULA}]"


@pytest.mark.parametrize(("words", "expected"), OWN_VALUES + OF_BENCHMARKS)
def test_an_option_chosen_on_the_command_line_has_its_own_values(run, search, words, expected):
    code, out, err = run("train", search, *words.split(), "--cfg", "job")
    assert code == 0, err
    cfg = OmegaConf.create(out)
    assert {key: OmegaConf.select(cfg, key) for key in expected} == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            "curriculum=careful curriculum/advance=plateau",
            {"curriculum.advance": PLATEAU, "curriculum.sample.share": 0.33},
        ),
        ("experiment=mine callbacks=none", {"callbacks": {}}),
        ("experiment=far reach=everywhere", {"env.reach": None}),
    ],
)
def test_own_values_are_trained_with_and_noted(run, search, monkeypatch, words, expected):
    """In the config that the training gets, and in Hydra's note on it."""
    given = []
    monkeypatch.setattr(train, "train", lambda cfg, run_dir: given.append(cfg))
    code, _, err = run("train", search, *words.split(), "hydra.run.dir=run")
    assert code == 0, err
    for cfg in (given[0], OmegaConf.load("run/.hydra/config.yaml")):
        assert {key: OmegaConf.select(cfg, key) for key in expected} == expected


def test_a_config_is_composed_as_the_command_does(search):
    cfg = compose_training([search, "experiment=mine", "curriculum/advance=plateau"])
    assert cfg.curriculum.advance == PLATEAU and cfg.algo.lr == 0.5 and "hydra" not in cfg
    for words, message in (("seed=0,1", "several values"), ("+evaluation.foo=1", "no key 'foo'"), ("foo=1", "'foo'")):
        with pytest.raises(ValueError, match=message):
            compose_training([words])


@pytest.mark.slow
def test_own_values_in_a_sweep(run, search, monkeypatch):
    given = []
    monkeypatch.setattr(train, "train", lambda cfg, run_dir: given.append(cfg.curriculum.advance))
    run("train", "-m", search, "experiment=mine", "curriculum/advance=plateau,threshold", "hydra.sweep.dir=sweep")
    assert given[0] == PLATEAU and (given[1].window, given[1].occupancy) == (7, 0.5)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("model=mlp model.actor.hiden=1", "model.actor; did you mean 'hidden'?"),
        ("model=mlp model.actor.hiden=1 seed=0,1", "model.actor; did you mean 'hidden'?"),
        (
            "model=null",
            "expected model=<one of afterstate, afterstate_fcn, fcn4d, fcn4d_noclip, fcn_grasp, "
            "individual_grasp, individual_rl, mlp, ",
        ),
        ("model=mpl", "individual_rl, mlp, typical."),
        ("curriculum=careful curriculum/advance=plateau curriculum.advance.occupancy=1", "expected one of window, "),
    ],
)
@pytest.mark.parametrize("given", ["--config-dir {0}/own_model", "hydra.searchpath=[file://{0}/own_model]"])
def test_hints_know_the_user_s_folders(run, monkeypatch, words, expected, given):
    monkeypatch.syspath_prepend(str(CURRICULA.parent / "own_model"))
    given = given.replace("own_model", "own_curriculum") if "careful" in words else given
    flags = ["-m"] if "seed=0,1" in words else []
    code, _, err = run("train", *flags, *given.format(CURRICULA.parent).split(), *words.split())
    assert code == 2 and expected in err.splitlines()[-1]


@pytest.mark.parametrize(("command", "words", "expected"), BAD)
def test_bad_input_is_one_sentence(run, tmp_path, command, words, expected):
    code, _, err = run(command, *words.split())
    noise = "Error executing job with overrides"  # of a sweep: Hydra's own line
    lines = [line for line in err.splitlines() if line.strip() and "Warning" not in line and noise not in line]
    assert code not in (0, None)
    assert len(lines) == 1 and lines[0].startswith("error: "), err
    for part in expected:
        assert part in lines[0]
    folders = {"outputs", "outputs/train", "outputs/evaluate", "outputs/sweep"}
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} <= folders


@pytest.mark.parametrize(("command", "words", "expected"), BAD_VALUES)
def test_a_bad_value_is_one_sentence(tmp_path, command, words, expected):
    task = {"train": train.train, "evaluate": evaluate.run}[command]
    with pytest.raises(ValueError) as caught:
        task(composed(*words.split(), name=command), tmp_path)
    assert "\n" not in str(caught.value)
    for part in expected:
        assert part in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} <= {".lock"}


def test_bad_files_are_named(run, tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "typo.yaml").write_text("# @package _global_\nalgo: {gama: 0.9}\n")
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n1,x,1\n")
    code, _, err = run("train", "items=recorded", "items.path=items.csv")
    assert code == 2 and "items.csv, line 3" in err and "'1,x,1'" in err
    code, _, err = run("train", "--config-dir", ".", "experiment=typo")
    assert code == 2 and "algo.gama: there is no key 'gama' in algo; did you mean 'gamma'?" in err


def test_a_failure_leaves_earlier_results_in_the_folder(run, tmp_path):
    (tmp_path / "tote.png").write_text("earlier")
    code, _, err = run("evaluate", "planner=joint_dbl", "env.rotations=5", "hydra.run.dir=.")
    assert code == 2 and "rotations=5" in err
    assert (tmp_path / "tote.png").read_text() == "earlier"


def test_full_error_shows_the_traceback(run, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="rotations=5"):
        run("train", "env.rotations=5")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("train", "--cfg job"),
        ("evaluate", "--cfg all"),
        ("train", "--help"),
        ("evaluate", "--cfg job -p env --resolve"),
        ("train", "--version"),
    ],
)
def test_hydra_s_flags_with_its_debugging_output(run, tmp_path, name, words):
    code, out, err = run(name, "hydra.verbose=true", *words.split())
    assert code == 0, err
    assert "1.3" in out if words == "--version" else "tote_size" in out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_hydra_s_debugging_output_of_a_run(run, monkeypatch):
    given = []
    monkeypatch.setattr(train, "train", lambda cfg, run_dir: given.append((cfg.seed, run_dir.name)))
    code, _, err = run("train", "hydra.verbose=true", "seed=3", "hydra.run.dir='${seed} and it\\'s'")
    assert code == 0 and given == [(3, "3 and it's")], err
    assert run("train", "seed=4,5", "hydra.mode=MULTIRUN", "hydra.sweep.dir=sweep")[0] == 0
    assert given[1:] == [(4, "seed-4"), (5, "seed-5")]


def test_several_folders_of_config_files(run, monkeypatch):
    given = []
    monkeypatch.setattr(train, "train", lambda cfg, run_dir: given.append(cfg))
    folders = [word for name in ("own_model", "own_curriculum") for word in ("--config-dir", str(EXAMPLES / name))]
    code, _, err = run("train", *folders, "model=mlp", "curriculum=careful")
    assert code == 0 and given[0].curriculum.advance.window == 200 and given[0].model.actor.hidden, err


@pytest.mark.parametrize("option", ["careful", "paper"])  # of a folder of the user's, and of ours
def test_an_option_in_two_folders_is_refused(run, tmp_path, option):
    (tmp_path / "curriculum").mkdir()
    (tmp_path / "curriculum" / f"{option}.yaml").write_text("defaults: [paper]\n")
    folders = ["--config-dir", str(CURRICULA), f"hydra.searchpath=[file://{tmp_path}]"]
    assert run("train", *folders, "--cfg", "job")[0] == 0
    code, _, err = run("train", *folders, f"curriculum={option}", "--cfg", "job")
    assert code == 2 and f"curriculum={option}: it is in " in err, err
    assert f"{tmp_path}/curriculum/{option}.yaml" in err and err.count(f"/curriculum/{option}.yaml") == 2, err


@pytest.mark.parametrize(
    ("name", "words", "expected"),
    [
        ("train", "--help", "afterstate, afterstate_gpu, buffer, cpu, mixed"),
        ("evaluate", "--help", "best_fit, corner, "),
        ("train", "-m algo.gama=0.9,1", "'gamma'"),
        ("train", "curriculum.levels=[{},{tote_hight:2}]", "curriculum.levels[1]; did you mean 'tote_height'?"),
        ("train", "resume={run} gama=1", "did you mean 'algo.gamma'?"),
        ("evaluate", "checkpoint=pretrained/r4 model.actor.filterz=8", "'filters'"),
        ("evaluate", "checkpoint=nowhere", "no checkpoint there"),
        ("plan", "pretrained/r4 --rotatoins 2", "expected --rotations."),
        ("serve", "--tote_height=2", "expected --tote-height."),
        ("export", "pretrained/r4 scores.onnx --rotaton", "expected --rotations."),
        ("physics", "plans.jsonl --metod=settle", "expected --method."),
    ],
)
def test_what_needs_no_torch_does_not_wait_for_it(name, words, expected, smoke_run, tmp_path):
    code = f"import sys; from pickplace.cli import {name}\ntry: {name}()\nfinally: assert 'torch' not in sys.modules"
    path, words = str(Path(pickplace.__file__).parents[1]), words.replace("{run}", str(smoke_run)).split()
    result = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
        capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == (0 if "--help" in words else 2) and expected in result.stdout + result.stderr
    assert list(tmp_path.iterdir()) == []


def test_help_names_the_purpose_and_the_options_of_each_group(run):
    code, out, err = run("train", "--config-dir", str(CURRICULA), "seed=3", "items=mixed", "--help")
    assert code == 0 and f"  items=mixed                      {GROUPS['items']}\n      boxes, cut1" in out, err
    assert "adaptive, buffer, careful, learning_progress" in out and "  seed: 0    " in out
    assert GROUPS.keys() == {str(path.parent.relative_to(conf_dir())) for path in conf_dir().glob("*/**/*.yaml")}
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("rotations", ["env.rotations"]), ("env.rotation", ["env.rotations"]), ("lr", ["algo.lr"]),
        ("seed", ["seed"]), ("advance", ["curriculum/advance"]), ("gripper.cup", ["env.gripper.cup"]),
        ("total-frames", ["total_frames"]), ("run.dir", ["hydra.run.dir"]), ("itmes.weights", ["items.weights"]),
        ("intervall", ["evaluation_interval", "checkpoint_interval", "progress_interval"]), ("xyz", []),
    ],
)  # fmt: skip
def test_names_that_a_user_may_have_meant(key, expected):
    names = known_names(compose_plain("train"))
    assert full_names(key, names) == expected


def test_overrides_on_a_saved_config():
    saved = composed("experiment=smoke")
    changed = apply_overrides(saved, ["algo.gamma=0.9", "total_frames=99", "env.tote_size=[7,7,2]"])
    assert (changed.algo.gamma, changed.total_frames, changed.env.tote_size) == (0.9, 99, [7, 7, 2])
    assert saved.algo.gamma == 0.99
    other = composed("items=tall")["items"]
    swapped = apply_overrides(saved, ["items=tall", "items.height=[1,2]"], {"items": other})
    assert swapped == apply_overrides(saved, ["items.height=[1,2]", "items=tall"], {"items": other})
    assert swapped["items"].height == [1, 2]


def test_a_whole_number_may_be_written_with_an_exponent(tmp_path):
    words = ["total_frames=1e5", "algo.minibatch_size=6.4e1", "env.num_envs=16e0", "model.actor.filters=1e1"]
    words += ["curriculum/advance=staged", "curriculum.advance.stages=[{frames: 2e3, height: 5}]"]
    words += ["warm_start=imitate", "warm_start.frames=1e3"]
    cfg = composed(*words, "items.weights=[1e1,20,0.5,1.0]", "threads=1", "rollout_length=1e1")
    trainer = Trainer(cfg, tmp_path)
    trainer.collector.shutdown()
    assert json.dumps(trainer.saved_config["items"]["weights"]) == "[10, 20, 0.5, 1.0]"
    found = (cfg.total_frames, cfg.env.num_envs, cfg.rollout_length, cfg.warm_start.frames)
    assert found == (100_000, 16, 10, 1_000) and all(type(value) is int for value in found)
    assert trainer.algorithm.inner.minibatch_size == 64 and trainer.policy.network.hidden.in_features == 10
    with pytest.raises(ValueError, match=r"total_frames=100000\.5: expected a whole number"):
        check_settings(composed("total_frames=100000.5"))
    saved = apply_overrides(composed(), ["total_frames=2e6"])
    assert type(saved.total_frames) is int
    ours = composed("planner=joint_dbl", "evaluation.episodes=1e2", name="evaluate")
    prepare(ours)
    assert type(ours.evaluation.episodes) is int


def test_notes_of_a_run_are_read_unresolved(tmp_path, monkeypatch):
    monkeypatch.setenv("MY_SECRET", "secret")
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text("- seed=1\n- a='${oc.env:MY_SECRET}'\n- [nested]\n- 5\n")
    assert noted_command(tmp_path) == ["seed=1", "a='${oc.env:MY_SECRET}'"]
    assert noted_command(tmp_path / "nowhere") == []


def test_errors_hold_nothing_that_controls_a_terminal():
    assert sentence(ValueError("bad \x1b[31m key\x07")) == "bad \\x1b[31m key\\x07"


def test_a_preset_in_a_group_of_ones_own(run, tmp_path):
    (tmp_path / "mine" / "study").mkdir(parents=True)
    (tmp_path / "mine" / "study" / "a.yaml").write_text("# @package _global_\nseed: 7\n")
    code, out, err = run("train", "--config-dir", "mine", "+study=a", "--cfg", "job")
    assert code == 0 and "seed: 7" in out and "study" not in out, err


@pytest.mark.parametrize("word", ["~logger=csv", "~logger", "~callbacks=none"])
def test_a_group_may_be_removed(run, word):
    code, out, err = run("train", word, "--cfg", "job")
    assert code == 0 and "algo:" in out and f"\n{word[1:].partition('=')[0]}:" not in out, err


def test_a_number_that_python_cannot_read_is_named(run):
    code, _, err = run("train", f"seed={'9' * 5000}")
    assert code == 2 and "seed=999" in err and err.count("\n") == 1
