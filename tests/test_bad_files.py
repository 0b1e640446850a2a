"""Damaged, endless, occupied or full files, folders and streams: the error is one sentence, and nothing is lost."""

import copy
import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import composed
from matplotlib.figure import Figure
from omegaconf import OmegaConf

import pickplace
from pickplace.algorithms.base import load_optimizer
from pickplace.common.errors import one_sentence
from pickplace.common.files import read_file, replaced_file
from pickplace.envs.saved_state import check_saved_states
from pickplace.evaluation import evaluate
from pickplace.evaluation.result import episode_settings, read_comparison
from pickplace.items.distributions import Recorded
from pickplace.rules.observation import ToteDepth
from pickplace.runs import checkpoint
from pickplace.runs.folder import (
    OccupiedError,
    changed_values,
    is_claimed,
    noted_command,
    refuse_for_job,
    refuse_for_run,
    refuse_for_sweep,
    refuse_links,
)
from pickplace.runs.locate import locate
from pickplace.runs.resume import StopRequest
from pickplace.serve import json_lines
from pickplace.serve.request import RequestLimits
from pickplace.training import trainer
from pickplace.training.train import resume_run, train

TOTE = "env.tote_size=[4,4,2]"
SHORT = ["planner=joint_dbl", TOTE, "evaluation.episodes=2", "evaluation.latency_decisions=0", "evaluation.replay=0"]
FULL = OSError(28, "No space left on device")


@pytest.fixture
def told(capsys):
    """Call a function that must fail; return the text that a command prints then."""

    def call(function, *arguments):
        with pytest.raises(SystemExit) as end, one_sentence():
            function(*arguments)
        assert end.value.code == 2
        return capsys.readouterr().err

    return call


def make(kind: str, path: Path) -> Path:
    """Make an entry that is no readable file, and return its path."""
    if kind.startswith("/"):
        return Path(kind)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "link to a device":
        path.symlink_to("/dev/zero")
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(2**40)
    return path


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", "folder", "link to a device", "large", "/dev/zero", "/proc/kmsg"])
@pytest.mark.parametrize(
    "read",
    [Recorded, json_lines.read_map, lambda path: read_comparison(path, {})],
    ids=["items.path", "--bin", "compare"],
)
def test_only_regular_files_of_limited_size_are_read(tmp_path, read, kind):
    path = make(kind, tmp_path / "file")
    with pytest.raises(ValueError, match=str(path)):
        read(path)


def test_an_endless_file_of_size_0_is_empty():
    assert read_file("/proc/kmsg") == b""


BOMB = "a: &a [x]\n" + "".join(f"{b}: &{b} [{f'*{a}, ' * 9}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
NOTES = {
    "alias bomb": BOMB, "broken": "a: [", "deep": "[" * 100_000, "no date": "2001-13-45", "no time": "!!timestamp x",
    "numbers": "hydra: {runtime: {config_sources: [{path: 3, provider: command-line}]}, overrides: {hydra: [5]}}",
    "class": "!!python/object/apply:os.getcwd []", "interpolation": "seed: ${oc.env:HOME}\nalgo: {lr: '${no.such}'}",
    "list": "[[1], 2]", "large": "a: " + "x" * 2**21,
}  # fmt: skip


@pytest.mark.timeout(60)
@pytest.mark.parametrize("note", NOTES)
def test_a_note_of_hydra_is_never_resolved(tmp_path, note):
    (tmp_path / ".hydra").mkdir()
    for name in ("config", "overrides", "hydra"):
        (tmp_path / ".hydra" / f"{name}.yaml").write_text(NOTES[note])
    assert noted_command(tmp_path) == []
    cfg = composed("experiment=smoke")
    changed = {word.partition("=")[0] for word in changed_values(tmp_path, cfg)}
    assert note != "interpolation" or "seed" not in changed
    OmegaConf.save(cfg, tmp_path / ".hydra" / "config.yaml")
    cfg.algo.epochs, cfg.model.critic.tote_clip = 3, 4  # the second one replaces a reference
    assert changed_values(tmp_path, cfg) == ["model.critic.tote_clip=4", "algo.epochs=3"]


@pytest.mark.timeout(60)
def test_a_report_does_without_notes_that_cannot_be_read(smoke_run, tmp_path):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    (run_dir / ".hydra").mkdir(exist_ok=True)
    for name, note in (("config", "alias bomb"), ("overrides", "broken"), ("hydra", "numbers")):
        (run_dir / ".hydra" / f"{name}.yaml").write_text(NOTES[note])
    (run_dir / "report.html").unlink()
    resume_run([f"resume={run_dir}"])
    assert "pickplace-train" in (run_dir / "report.html").read_text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"occupancy": {"per_episode": [0.5]}}, "a list of 3 numbers"),
        ({"occupancy": {"per_episode": [[0.5, 0.5, 0.5]]}}, "a list of 3 numbers"),
        ({"occupancy": {"per_episode": [0.5, float("nan"), 0.5]}}, "a list of 3 numbers"),
        ({"occupancy": {"per_episode": [0.5, 7, 0.5]}}, "a list of 3 numbers"),
        ({"occupancy": {"per_episode": [0.5, True, 0.5]}}, "a list of 3 numbers"),
        ({"occupancy": {"per_episode": 0.5}}, "a list of 3 numbers"),
        ({"occupancy": None}, "expected an evaluation.json"),
        ({"planner": "a\x1b[31m"}, "a name to print, got 'a\\x1b[31m'"), ({"planner": "a" * 101}, "a name to print"),
        ({"planner": 3}, "a name to print, got 3"), ({"stream": "x" * 10**6}, "its stream is 'xxx"),
        ({"env": {}}, "env.tote_size=[6, 6, 5]"), ({"env": {"tote_size": None}}, "env.tote_size=[6, 6, 5]"),
        ({"env": 3}, "expected an evaluation.json"),
    ],
)  # fmt: skip
def test_a_comparison_is_checked(told, tmp_path, change, words):
    ours = episode_settings(composed("evaluation.episodes=3", "env.tote_size=[4,4,2]", name="evaluate"))
    content = {**ours, "planner": "a", "occupancy": {"per_episode": [0.5] * 3}}
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps(content))
    read_comparison(path, ours)
    path.write_text(json.dumps({**content, "env": {k: v for k, v in ours["env"].items() if k != "height_unit"}}))
    read_comparison(path, ours)  # a missing key stands for its default
    if isinstance(change.get("env"), dict) and change["env"]:  # as in an older file without the key
        change = {"env": {key: value for key, value in ours["env"].items() if key not in change["env"]}}
    path.write_text(json.dumps({**content, **change}))
    err = told(read_comparison, path, ours)
    assert words in err and len(err) < 1000 and err.count("\n") == 1


def test_a_comparison_is_checked_before_playing(run, tmp_path, monkeypatch):
    (tmp_path / "digits.json").write_text("9" * 10_000)
    monkeypatch.setattr(evaluate, "play", lambda *_: pytest.fail("it played"))
    code, _, err = run("evaluate", "planner=joint_dbl", "compare=digits.json")
    words = "(Exceeds the limit (4300 digits) for integer string conversion: value has 10000 digits)."
    assert (code, err) == (2, f"error: compare='digits.json': expected an evaluation.json {words}\n")


@pytest.mark.parametrize("read", [lambda value: read_comparison(Path(value), {}), locate, Recorded])
@pytest.mark.parametrize("value", ["x" * 5000, "x/" * 2500], ids=["name", "path"])
def test_a_long_path_is_shortened(told, read, value):
    err = told(read, value)
    assert err.startswith("error: ") and len(err) < 500


@pytest.mark.parametrize(
    ("read", "path", "expected"),
    [
        (Recorded, "/dev/zero", "/dev/zero: a folder, link, pipe or device; expected a regular file"),
        (Recorded, ".", ".: a folder, link, pipe or device"),
        (Recorded, "/proc/kmsg", "/proc/kmsg: 0 bytes; expected a file with content"),
        (lambda path: read_comparison(Path(path), {}), "/proc/kmsg", "/proc/kmsg: 0 bytes"),
    ],
)
def test_a_file_that_cannot_be_read_is_named_with_the_reason(told, read, path, expected):
    err = told(read, path)
    assert expected in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("/proc/x", "No such file or directory; expected another path."),
        ("digits.json", "File exists; expected another path"),
        ("digits.json/x", "Not a directory; expected another path"),
    ],
)
def test_a_run_folder_that_cannot_be_made_is_named_with_the_reason(run, tmp_path, path, reason):
    (tmp_path / "digits.json").touch()
    code, _, err = run("evaluate", "planner=joint_dbl", f"hydra.run.dir={path}")
    assert code == 2 and f"{path}: {reason}" in err and err.count("\n") == 1


def test_an_echoed_value_of_a_checkpoint_is_shortened(tmp_path):
    (tmp_path / "state.json").write_text(json.dumps({"schema": [1] * 10**5}))
    (tmp_path / "state.safetensors").touch()
    with pytest.raises(checkpoint.CheckpointError, match="schema .1, 1") as error:
        checkpoint.read(tmp_path)
    assert len(str(error.value)) < 300


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_evaluation_overwrites_no_other_run(run, smoke_run, tmp_path):
    evaluation, one, trained = ["evaluate", *SHORT], tmp_path / "one", shutil.copytree(smoke_run, tmp_path / "trained")
    assert run(*evaluation, f"hydra.run.dir={one}")[0] == 0
    for folder, command in ((one, evaluation), (trained, evaluation), (one, ["train"])):
        before = files(folder)
        code, _, err = run(*command, f"hydra.run.dir={folder}")
        assert code == 2 and err.startswith(f"error: {folder}: there is a") and err.count("\n") == 1
        assert files(folder) == before
    with pytest.raises(OccupiedError, match="there is an evaluation already"):  # a job of a sweep
        evaluate.run(composed(*SHORT, name="evaluate"), one)
    refuse_for_run(trained / "evaluation")  # not refused


@pytest.fixture
def noted_run(smoke_run, tmp_path):
    """A run folder with a note of Hydra's."""
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    (run_dir / ".hydra").mkdir()
    (run_dir / ".hydra" / "hydra.yaml").touch()
    return run_dir


@pytest.mark.parametrize("part", ["checkpoints", "checkpoints/best", "checkpoints/new", ".hydra", ".hydra/new"])
def test_a_part_of_a_run_is_no_run_folder(noted_run, part):
    for refuse in (refuse_for_run, refuse_for_job):
        with pytest.raises(OccupiedError, match=f"^{noted_run / part}: a part of another run"):
            refuse(noted_run / part)


def test_no_command_runs_in_a_part_of_a_run(run, noted_run):
    before = files(noted_run)
    for command in (["evaluate", *SHORT], ["train", "experiment=smoke"]):
        code, _, err = run(*command, f"hydra.run.dir={noted_run}/checkpoints/best")
        assert code == 2 and f"{noted_run}/checkpoints/best: a part of another run" in err
    sweep = [f"hydra.sweep.dir={noted_run}", "hydra.sweep.subdir=checkpoints/best"]
    code, _, err = run("train", "-m", "experiment=smoke", *sweep)
    assert code == 2 and "a part of another run" in err and before.keys() <= files(noted_run).keys()
    assert not (noted_run / "checkpoints" / "best" / "metrics.csv").exists()


def test_a_run_whose_checkpoints_were_deleted_is_not_overwritten(noted_run):
    """A user may delete them to save space."""
    shutil.rmtree(noted_run / "checkpoints")
    before = files(noted_run)
    with pytest.raises(OccupiedError, match=f"^{noted_run}: there is a report of a training already"):
        refuse_for_run(noted_run)
    with pytest.raises(OccupiedError, match=f"^{noted_run}: there is a report of a training already"):
        train(composed("experiment=smoke"), noted_run)  # a job of a sweep
    assert files(noted_run) == before


@pytest.mark.parametrize("name", ["train.log", "metrics.csv", ".lock", "checkpoints/note", ".hydra/config.yaml"])
@pytest.mark.parametrize(
    ("make_link", "words"),
    [
        (lambda path, other: os.link(other, path), "a hard link"),
        (lambda path, other: path.symlink_to(other), "a link or no regular file"),
        (lambda path, other: path.symlink_to("nowhere"), "a link or no regular file"),
        (lambda path, other: os.mkfifo(path), "a link or no regular file"),
    ],
)
def test_a_run_folder_with_links_is_not_resumed(tmp_path, name, make_link, words):
    run_dir, other = tmp_path / "run", tmp_path / "mine.txt"
    (run_dir / name).parent.mkdir(parents=True)
    other.write_text("mine")
    refuse_links(run_dir)
    make_link(run_dir / name, other)
    with pytest.raises(ValueError, match=f"{run_dir / name}: {words}"):
        refuse_links(run_dir)


LINKS = {  # makers, and the words for each kind
    "hard": (lambda path, other: os.link(other, path), "a hard link"),
    "symbolic": (lambda path, other: path.symlink_to(other), "a link or no regular file"),
    "to itself": (lambda path, other: path.symlink_to(path), "a link or no regular file"),
}


@pytest.fixture
def prepared(tmp_path):
    """A run folder prepared by a stranger, which the user reaches by a link, and a file of the user."""
    (tmp_path / "disk" / "one" / ".hydra").mkdir(parents=True)
    (tmp_path / "runs").symlink_to("disk")
    (tmp_path / "mine.txt").write_text("mine")
    return tmp_path / "runs" / "one", tmp_path / "mine.txt"


@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("name", ["train.log", "evaluate.log", ".hydra/config.yaml", ".lock"])
def test_a_new_run_is_refused_where_a_link_is(prepared, kind, name):
    """Test a single run, a job of a sweep, and a sweep before it begins."""
    folder, other = prepared
    (make_link, words), notes = LINKS[kind], [".hydra", "train.log"]
    ways = [
        (refuse_for_run, folder),
        (refuse_for_job, folder),
        (lambda sweep: refuse_for_sweep(sweep, notes), folder.parent),
    ]
    for refuse, place in ways:
        refuse(place)
    make_link(folder / name, other)
    for refuse, place in ways:
        with pytest.raises(ValueError, match=f"^{folder / name}: {words}"):
            refuse(place)
    assert other.read_text() == "mine"


@pytest.mark.parametrize("flags", [["hydra.run.dir={}/one"], ["-m", "hydra.sweep.dir={}", "hydra.sweep.subdir=one"]])
@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_a_new_run_writes_through_no_link(run, tmp_path, prepared, command, flags):
    folder, other = prepared
    settings = ["experiment=smoke"] if command == "train" else SHORT
    command = [command, *(word.format(folder.parent) for word in flags), *settings]
    paths = [folder / name for name in (f"{command[0]}.log", ".hydra/config.yaml", ".lock")]
    for path, (make_link, _) in zip(paths, LINKS.values(), strict=True):
        make_link(path, other)
    before = sorted(tmp_path.rglob("*"))
    code, _, err = run(*command)
    assert code == 2 and re.match(f"error: {folder}/.*link.*", err) and err.count("\n") == 1
    assert other.read_text() == "mine" and sorted(tmp_path.rglob("*")) == before
    if command[0] == "evaluate" and "-m" not in command:
        for path in paths:
            path.unlink()
        assert run(*command)[0] == 0


def test_a_job_writes_through_no_link(run, tmp_path):
    """Also test a link below the sweep's folder, which is found when the job begins."""
    other, folder = tmp_path / "mine.txt", tmp_path / "runs" / "a" / "b"
    other.write_text("mine")
    folder.mkdir(parents=True)
    for name in ("metrics.csv", "failure.txt"):
        (folder / name).symlink_to(other)
    code, _, err = run("train", "-m", "experiment=smoke", "hydra.sweep.dir=runs", "hydra.sweep.subdir=a/b")
    assert code == 2 and "a link or no regular file" in err and other.read_text() == "mine"


def test_a_lock_that_is_a_link_is_not_opened(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    os.link(tmp_path / "mine.txt", tmp_path / ".lock")
    with pytest.raises(ValueError, match=".lock: a hard link"):
        is_claimed(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_replaced_file_is_whole_or_as_it_was(tmp_path):
    mine, path = tmp_path / "mine", tmp_path / "result.json"
    mine.write_text("mine")
    path.write_text("old")
    os.link(mine, tmp_path / ".result.new.json")
    with pytest.raises(OSError, match=f"No space left on device: '{path}'"), replaced_file(path) as new:
        new.write_text("half")
        raise FULL
    assert path.read_text() == "old" and mine.read_text() == "mine"
    path.unlink()
    os.link(mine, path)
    with replaced_file(path) as new:
        new.write_text("new")
    assert path.read_text() == "new" and mine.read_text() == "mine"
    assert {entry.name for entry in tmp_path.iterdir()} == {"mine", "result.json"}


def full(*_, **__):
    raise FULL


@pytest.mark.parametrize(
    ("command", "owner", "function", "words"),
    [
        ("evaluate", Figure, "savefig", "run/tote.png: {} The table above and the files that are there are whole."),
        ("train", "hydra.core.utils", "_save_config", "run: {}"),
        ("train", csv.DictWriter, "writeheader", "run/metrics.csv: {} Nothing had been saved before."),
        ("train", Figure, "savefig", "run/learning_curve.png: {} What was saved before is whole: "),
    ],
)  # fmt: skip
def test_a_full_disk_is_named(run, tmp_path, monkeypatch, command, owner, function, words):
    monkeypatch.setattr(sys.modules[owner] if isinstance(owner, str) else owner, function, full)
    settings = SHORT if command == "evaluate" else ["experiment=smoke", "threads=1", "total_frames=128"]
    code, _, err = run(command, *settings, f"hydra.run.dir={tmp_path}/run")
    reason = "No space left on device; expected free space."
    assert code == 2 and err.splitlines()[-1].startswith(f"error: {tmp_path}/{words.format(reason)}"), err
    assert (tmp_path / "run").exists() == (function == "savefig")
    assert not [path for path in tmp_path.rglob(".*") if ".new" in path.name]


@pytest.fixture(scope="module")
def smoke_training(smoke_run):
    """The environment of experiment=smoke, and the saved states of its collector."""
    training = trainer.Trainer(composed("experiment=smoke", "threads=1"), smoke_run)
    training.collector.shutdown()
    state, _ = checkpoint.read(smoke_run / "checkpoints" / "last")
    saved = state["collector"]
    check_saved_states(training.env, saved)
    return training.env, saved


@pytest.mark.parametrize(
    ("part", "index", "value", "words"),
    [
        ("surface", 0, -1, "surface: expected heights of 0 to tote_height"), ("surface", 0, 19, "surface: expected"),
        ("surface", 0, 0, "surface: expected cells that bear weight"),
        ("tote_height", 0, 0, "tote_height: expected"), ("volume", 0, -1, "volume"), ("volume", 0, 10**9, "volume"),
        ("steps", 0, -1, "steps"), ("steps", 0, 10**9, "steps"), ("episode", 0, -1, "episode"),
        ("item", (0, 0, 0), 99, "item: expected"), ("item", (0, 0, 4), -1, "item: expected"),
        ("item_seed", (), -1, "item_seed: expected"),
        ("occupancy", 0, 7.0, "the carried occupancy: expected what the state shows"),
    ],
)  # fmt: skip
def test_an_impossible_environment_is_refused(smoke_training, part, index, value, words):
    env, saved = smoke_training
    saved = copy.deepcopy(saved)
    environment = saved["environment"]
    (environment if part in environment else saved["carried"])[part][index] = value
    with pytest.raises(checkpoint.CheckpointError, match=f"environment is of no use: {words}"):
        check_saved_states(env, saved)


def test_an_impossible_environment_is_not_resumed(smoke_run, tmp_path):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    folder = run_dir / "checkpoints" / "last"
    state, facts = checkpoint.read(folder)
    state["collector"]["environment"]["surface"][0] = -1
    del facts["schema"], facts["sha256"]
    checkpoint.write(folder, state, facts)
    with pytest.raises(ValueError, match="environment is of no use: surface: expected heights of 0 to tote_height"):
        resume_run([f"resume={run_dir}", "total_frames=1280"])


class Noise(ToteDepth):
    """A term that draws random numbers."""

    def value(self, cell, state):
        return torch.rand_like(super().value(cell, state))


def test_a_term_that_draws_can_be_resumed(smoke, tmp_path, no_report):
    run_dir = tmp_path / "run"
    smoke(run_dir, "+env.observation.noise={_target_: test_bad_files.Noise}", "total_frames=128")
    resume_run([f"resume={run_dir}", "total_frames=256", "trust=test_bad_files"])


@pytest.mark.parametrize(("key", "value"), [("step", -1.0), ("exp_avg_sq", -1e-3)])
def test_negative_moments_are_refused(key, value):
    weight = torch.nn.Parameter(torch.zeros(2))
    moments = {"step": torch.tensor(3.0), "exp_avg": -torch.ones(2), "exp_avg_sq": torch.ones(2)}
    load_optimizer(torch.optim.Adam([weight]), {0: moments})
    with pytest.raises(checkpoint.CheckpointError, match=rf"optimizer is of no use: 0\|{key} is negative"):
        load_optimizer(torch.optim.Adam([weight]), {0: {**moments, key: torch.full_like(moments[key], value)}})


@pytest.mark.parametrize("kind", [torch.optim.SGD, torch.optim.AdamW, torch.optim.RMSprop])
def test_any_optimizer_with_several_groups_is_restored(kind):
    """Its settings are not restored: the config has them."""

    def make(**settings):
        torch.manual_seed(0)
        weights = [torch.nn.Parameter(torch.randn(size)) for size in (2, 3, 4)]
        return kind([{"params": weights[:1]}, {"params": weights[1:]}], **settings), weights

    trained, weights = make(lr=0.1, **({} if kind is torch.optim.AdamW else {"momentum": 0.9}))
    sum(weight.square().sum() for weight in weights[:2]).backward()  # the third has no state
    trained.step()
    state = trained.state_dict()["state"]
    restored, own = make(lr=0.2, **({} if kind is torch.optim.AdamW else {"momentum": 0.9}))
    before = [weight.clone() for weight in own]
    load_optimizer(restored, state)
    found = restored.state_dict()["state"]
    assert found.keys() == state.keys() == {0, 1} and restored.param_groups[0]["lr"] == 0.2
    assert all(torch.equal(found[n][key], value) for n in state for key, value in state[n].items())
    assert all(map(torch.equal, before, own))
    for wrong in ({7: state[0]}, {1: state[0]}, {0: {}}):
        with pytest.raises(checkpoint.CheckpointError, match="optimizer"):
            load_optimizer(restored, wrong)


@pytest.fixture
def plan(run):
    """Run ``pickplace-plan``, which must refuse; returns its standard error."""

    def call(*arguments):
        code, _, err = run("plan", "pretrained/r4", *arguments)
        assert code == 2
        return err

    return call


@pytest.mark.parametrize("flag", [
    "--accuracy=0.7", "--cell-size=-1", "--cell-size=nan", "--alternatives=-1", "--tote-height=1e9",
    f"--alternatives={10**20}",
    "--tote-height=2.5", "--candidates=0", "--rotations=5", "--threads=-1",
])  # fmt: skip
def test_impossible_flags_are_refused_before_the_first_line(plan, monkeypatch, flag):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO()))
    assert flag.partition("=")[0].lstrip("-").replace("-", "_") in plan(flag)


def test_maps_are_named_by_their_files(plan, tmp_path):
    names = good, flat, large, nothing = [tmp_path / f"{name}.npy" for name in ("good", "flat", "large", "nothing")]
    item = np.zeros((5, 5))
    item[1, 1] = 1
    for path, values in zip(names, (item, np.zeros(5), np.full((6, 6), 99), item * 0), strict=True):
        np.save(path, values)
    (tmp_path / "zip.npy").write_bytes(b"PK\x03\x04 no archive")
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10**12,)}"
    (tmp_path / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + (60).to_bytes(2, "little") + shape)
    for bin_map, tote_map, named in (
        (flat, large, flat), (good, flat, flat), (good, large, large), (nothing, good, good),
        (nothing, nothing, nothing),
        (tmp_path / "zip.npy", good, tmp_path / "zip.npy"), (tmp_path / "huge.npy", good, tmp_path / "huge.npy"),
    ):  # fmt: skip
        assert plan("--bin", bin_map, "--tote", tote_map).startswith(f"error: {named}: ")


def test_an_endless_line_is_answered_and_skipped():
    class Endless:
        """A stream whose first line has 100 bytes; a reader may ask for at most 9 at a time."""

        content = b"x" * 100 + b"\n{}\n" + b" " * 8 + b"\n" + b"y" * 9

        def readline(self, limit):
            assert 0 < limit <= 9
            line, end, _ = self.content[:limit].partition(b"\n")
            self.content = self.content[len(line + end) :]
            return line + end

    lines = list(json_lines.read_lines(Endless(), 8))
    assert lines == [b"x" * 9, b"{}\n", b" " * 8 + b"\n", b"y" * 9]
    with pytest.raises(ValueError, match="more than 8 bytes"):
        RequestLimits(8, 10).check(lines[0])


@pytest.mark.parametrize("name", ["stdin", "stdout"])
def test_a_closed_stream_ends_in_a_sentence(plan, monkeypatch, name):
    monkeypatch.setattr(sys, name, None)
    assert plan().startswith("error: standard input or output is closed; expected")


def test_a_full_output_ends_in_a_sentence(monkeypatch, capsys):
    with open("/dev/full", "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit) as end, one_sentence():
            sys.stdout.write("x")
    assert end.value.code == 2 and "error: standard output: No space left" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["gymnasium", "torchrl"])  # early, and late
def test_ctrl_c_while_a_command_is_imported(tmp_path, module):
    code = f"""
import os, signal, sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["pickplace-evaluate", "planner=joint_dbl"]
from pickplace.cli import evaluate
evaluate()
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(pickplace.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_pickplace_is_imported_in_an_interpreter_without_arguments():
    code = f"import sys; sys.argv.clear(); sys.path.insert(0, {str(Path(pickplace.__file__).parents[1])!r}); "
    subprocess.run([sys.executable, "-c", code + "import pickplace"], check=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_request_knows_its_signal(number):
    request = StopRequest()
    try:
        assert request.signal is None
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGHUP)  # a terminal sends several
        assert request.signal == number
    finally:
        request.restore()


def test_nohup_keeps_working():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        request = StopRequest()
        os.kill(os.getpid(), signal.SIGHUP)
        assert request.signal is None
        request.restore()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
