"""Checkpoints: what goes in comes out, and a reader never meets half of one."""

import hashlib
import json
import os
import pickle
import shutil
import struct

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from pickplace.runs import checkpoint
from pickplace.runs.checkpoint import CheckpointError
from pickplace.runs.loggers import CsvLogger, read_csv

leaves = st.one_of(
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=False),
    st.booleans(),
    st.none(),
    st.lists(st.floats(-10, 10, width=32), max_size=4).map(lambda x: torch.tensor(x)),
    st.integers(-9, 9).map(torch.tensor),
)
keys = st.one_of(st.integers(0, 99), st.text("abc.xyz", min_size=1, max_size=5))
trees = st.dictionaries(
    keys, st.recursive(leaves, lambda c: st.dictionaries(keys, c, min_size=1, max_size=3)), max_size=4
)


def same(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    return type(a) is type(b) and a == b


@settings(max_examples=60)
@given(tree=trees)
def test_round_trip(tree, tmp_path_factory):
    folder = tmp_path_factory.mktemp("round") / "last"
    checkpoint.write(folder, {"policy": {}, "tree": tree}, {"frames": 3, "config": {}})
    state, facts = checkpoint.read(folder)
    assert same({"policy": {}, "tree": tree}, state)
    assert facts["frames"] == 3


def test_a_kill_between_the_renames_loses_nothing(tmp_path):
    run = tmp_path / "run"
    folder = run / "checkpoints" / "last"
    checkpoint.write(folder, {"policy": {}, "x": torch.ones(2)}, {"frames": 1, "config": {}})
    folder.rename(folder.with_name(".last.old"))  # killed right after this
    found = checkpoint.locate(run, prefer="last")
    assert checkpoint.read(found)[1]["frames"] == 1
    checkpoint.write(folder, {"policy": {}, "x": torch.zeros(2)}, {"frames": 2, "config": {}})
    assert checkpoint.read(checkpoint.locate(run, prefer="last"))[1]["frames"] == 2
    assert [path.name for path in folder.parent.iterdir()] == ["last"]


def test_a_kill_while_writing_leaves_the_old_one(tmp_path, monkeypatch):
    folder = tmp_path / "last"
    checkpoint.write(folder, {"policy": {}, "x": torch.ones(2)}, {"frames": 1, "config": {}})

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.raises(CheckpointError, match="cannot be written .No space left on device"):
        checkpoint.write(folder, {"policy": {}, "x": torch.zeros(2)}, {"frames": 2, "config": {}})
    assert [path.name for path in tmp_path.iterdir()] == ["last"]
    monkeypatch.undo()
    assert checkpoint.read(folder)[1]["frames"] == 1
    checkpoint.write(folder, {"policy": {}, "x": torch.zeros(2)}, {"frames": 3, "config": {}})
    assert [path.name for path in tmp_path.iterdir()] == ["last"]


def test_locate_knows_runs_and_checkpoints(tmp_path):
    checkpoint.write(tmp_path / "checkpoints" / "best", {}, {})
    checkpoint.write(tmp_path / "checkpoints" / "last", {}, {})
    assert checkpoint.locate(tmp_path).name == "best"
    assert checkpoint.locate(tmp_path, prefer="last").name == "last"
    assert checkpoint.locate(tmp_path / "checkpoints" / "last").name == "last"
    with pytest.raises(CheckpointError, match="no checkpoint there"):
        checkpoint.locate(tmp_path / "elsewhere")


def test_a_reader_that_comes_between_the_files_reads_again(tmp_path, monkeypatch):
    facts = {"frames": 1, "config": {}}
    checkpoint.write(tmp_path / "last", {"policy": {"w": torch.zeros(3)}}, facts)
    load, times = checkpoint.load, []

    def replaced(blob):
        times.append(1)
        if len(times) == 1:
            checkpoint.write(tmp_path / "last", {"policy": {"w": torch.ones(3)}}, facts)
            raise ValueError("altered")
        return load(blob)

    monkeypatch.setattr(checkpoint, "load", replaced)
    assert checkpoint.read(tmp_path / "last")[1]["frames"] == 1


def test_restore_names_what_does_not_fit():
    def make():
        return torch.nn.Linear(2, 3)

    state = torch.nn.Linear(2, 3).state_dict()
    assert torch.equal(checkpoint.restore(make, state, "policy").weight, state["weight"])
    with pytest.raises(CheckpointError, match=r"policy does not fit .* weight is float32 of shape \(4, 2\)"):
        checkpoint.restore(make, torch.nn.Linear(2, 4).state_dict() | {"bias": torch.zeros(3)}, "policy")
    with pytest.raises(CheckpointError, match="bias is missing"):
        checkpoint.restore(make, {"weight": torch.zeros(3, 2)}, "policy")
    with pytest.raises(CheckpointError, match="bias is int, expected float32"):
        checkpoint.restore(make, {"weight": torch.zeros(3, 2), "bias": 3}, "policy")
    with pytest.raises(CheckpointError, match="more is not expected"):
        checkpoint.restore(make, {**state, "more": torch.zeros(1)}, "policy")
    with pytest.raises(CheckpointError, match="policy is of no use: bias holds values.* not finite"):
        checkpoint.restore(make, {**state, "bias": torch.full((3,), float("nan"))}, "policy")


def test_a_config_that_asks_for_more_memory_than_there_is_takes_none():
    with pytest.raises(CheckpointError, match="weight is .* of shape .3, 2., expected .* of shape .10000000000, 2."):
        checkpoint.restore(lambda: torch.nn.Linear(2, 10**10), torch.nn.Linear(2, 3).state_dict(), "policy")


@pytest.mark.parametrize("name", [checkpoint.FACTS, checkpoint.TENSORS])
def test_links_are_refused(tmp_path, name):
    folder = tmp_path / "last"
    checkpoint.write(folder, {"policy": {}}, {"frames": 1, "config": {}})
    (folder / name).rename(tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    with pytest.raises(CheckpointError, match=f"{name} is a link"):
        checkpoint.read(folder)


@pytest.mark.parametrize("name", [checkpoint.FACTS, checkpoint.TENSORS])
def test_a_pipe_is_not_waited_for(tmp_path, name):
    folder = tmp_path / "last"
    checkpoint.write(folder, {"policy": {}}, {"frames": 1, "config": {}})
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(CheckpointError, match=f"{name} is a link or no file"):
        checkpoint.read(folder)


@pytest.mark.parametrize(
    "tensor",
    [
        {"dtype": "F4", "shape": [2], "data_offsets": [0, 1]},
        {"dtype": "F8_E8M0", "shape": [1], "data_offsets": [0, 1]},
        {"dtype": "F32", "shape": [0, 2**63], "data_offsets": [0, 0]},
        {"dtype": "F32", "shape": [2**62, 2**62], "data_offsets": [0, 8]},
        {"dtype": "F32", "shape": [2], "data_offsets": [0, 2**40]},
    ],
)
def test_tensors_of_absurd_types_and_sizes(tmp_path, tensor):
    folder = tmp_path / "last"
    checkpoint.write(folder, {"policy": {}}, {"frames": 1, "config": {}})
    header = json.dumps({"policy|x": tensor}).encode()
    blob = struct.pack("<Q", len(header)) + header + bytes(tensor["data_offsets"][1] % 64)
    facts = json.loads((folder / checkpoint.FACTS).read_text())
    (folder / checkpoint.TENSORS).write_bytes(blob)
    (folder / checkpoint.FACTS).write_text(json.dumps({**facts, "sha256": hashlib.sha256(blob).hexdigest()}))
    with pytest.raises(CheckpointError, match="cannot be read") as caught:
        checkpoint.read(folder)
    assert "\n" not in str(caught.value)


class Evil:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("name", [checkpoint.TENSORS, checkpoint.FACTS, "state.pt", "checkpoint.pkl", ""])
def test_a_pickle_is_never_run_whatever_its_name(tmp_path, name):
    folder, made = tmp_path / "run" / "checkpoints" / "last", tmp_path / "made"
    checkpoint.write(folder, {"policy": {}}, {"frames": 1, "config": {}})
    blob = pickle.dumps(Evil(made))
    assert pickle.loads(blob) and made.unlink() is None  # it would
    if name == checkpoint.TENSORS:  # with the right checksum
        facts = json.loads((folder / checkpoint.FACTS).read_text())
        facts["sha256"] = hashlib.sha256(blob).hexdigest()
        (folder / checkpoint.FACTS).write_text(json.dumps(facts))
    if name:
        (folder / name).write_bytes(blob)
    else:
        shutil.rmtree(folder)
        folder.write_bytes(blob)
    if name in (checkpoint.TENSORS, checkpoint.FACTS, ""):
        with pytest.raises(CheckpointError) as caught:
            checkpoint.read(checkpoint.locate(folder))
        assert "\n" not in str(caught.value)
    else:
        checkpoint.read(checkpoint.locate(folder))
    assert not made.exists()


paths = st.one_of(
    st.sampled_from(["policy", "policy|x", "policy|0", "policy|0|y", "|", "../x"]), st.text("a|0/.", max_size=5)
)
plain = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=6)),
    lambda c: st.one_of(st.lists(c, max_size=3), st.dictionaries(paths, c, max_size=4)),
    max_leaves=8,
)


@settings(max_examples=150)
@given(
    st.dictionaries(st.sampled_from(["state", "config", "frames", "schema", "policy", "best"]), plain),
    st.dictionaries(paths, st.builds(torch.zeros, st.just(2)), max_size=4),
    st.binary(max_size=3),
    st.integers(0, 400),
)
def test_whatever_a_checkpoint_holds_it_is_read_or_refused(tmp_path_factory, facts, tensors, noise, at):
    """With the right checksum, so that what is refused is refused for what it is."""
    folder = tmp_path_factory.mktemp("any") / "checkpoints" / "last"
    folder.mkdir(parents=True)
    blob = save(tensors)
    blob = blob[:at] + noise + blob[at + len(noise) :]
    digest = hashlib.sha256(blob).hexdigest()
    content = {"schema": 1, "frames": 0, "config": {}, "state": {"policy|x": 1}, "sha256": digest, **facts}
    (folder / checkpoint.TENSORS).write_bytes(blob)
    (folder / checkpoint.FACTS).write_text(json.dumps(content))
    try:
        state, facts = checkpoint.read(checkpoint.locate(folder))
        assert isinstance(state["policy"], dict) and isinstance(facts["config"], dict) and facts["frames"] >= 0
    except CheckpointError as error:
        assert "\n" not in str(error)
    assert {path.name for path in folder.parent.parent.rglob("*")} == {
        "checkpoints",
        "last",
        checkpoint.FACTS,
        checkpoint.TENSORS,
    }


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a":' * 200_000, '{"frames": ' + "9" * 10_000 + "}", "\xff", ""])
def test_facts_that_are_no_facts(tmp_path, text):
    folder = tmp_path / "last"
    checkpoint.write(folder, {"policy": {}}, {"frames": 1, "config": {}})
    (folder / checkpoint.FACTS).write_bytes(text.encode("latin-1"))
    with pytest.raises(CheckpointError, match="cannot be read"):
        checkpoint.read(folder)


@pytest.mark.parametrize("row", ["xyz,1", "1,xyz", ",2", "inf,1", "1,2,3"])
def test_metrics_that_are_no_numbers(tmp_path, row):
    (tmp_path / "metrics.csv").write_text(f"frames,a\n1,2\n{row}\n")
    with pytest.raises(ValueError, match="metrics.csv, line 3: expected a number"):
        read_csv(tmp_path / "metrics.csv")


def test_metrics_survive_a_cut_line_and_a_resume(tmp_path):
    logger = CsvLogger(tmp_path)
    logger.log({"a": 1.0}, 10)
    logger.log({"a": 2.0, "b": 5.0}, 20)
    logger.log({"a": 3.0}, 30)
    logger.close()
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("40,4.")
    assert [row["frames"] for row in read_csv(tmp_path / "metrics.csv")] == [10, 20, 30]
    logger = CsvLogger(tmp_path, frames=20)
    logger.log({"a": 7.0}, 30)
    logger.close()
    rows = read_csv(tmp_path / "metrics.csv")
    assert rows == [{"frames": 10, "a": 1.0}, {"frames": 20, "a": 2.0, "b": 5.0}, {"frames": 30, "a": 7.0}]
