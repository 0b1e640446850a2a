"""Checkpoints: what goes in comes out, and a reader never meets half of one."""

import hashlib
import json
import os
import pickle
import shutil
import struct
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from pickplace.runs import checkpoint
from pickplace.runs.locate import CheckpointError, locate

leaves = st.one_of(
    st.integers(-(2**40), 2**40), st.floats(allow_nan=False), st.booleans(), st.none(),
    st.lists(st.floats(-10, 10, width=32), max_size=4).map(torch.tensor), st.integers(-9, 9).map(torch.tensor),
)  # fmt: skip
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


@settings(max_examples=25)
@given(tree=trees)
def test_round_trip(tree, tmp_path_factory):
    folder = tmp_path_factory.mktemp("round") / "last"
    checkpoint.write(folder, {"policy": {}, "tree": tree}, {"frames": 3, "config": {}})
    state, facts = checkpoint.read(folder)
    assert same({"policy": {}, "tree": tree}, state)
    assert facts["frames"] == 3


def write(folder, value=0.0, frames=1):
    """Write a small checkpoint."""
    checkpoint.write(folder, {"policy": {}, "x": torch.full((2,), value)}, {"frames": frames, "config": {}})
    return folder


def write_tensors(folder, blob):
    """Replace a checkpoint's tensors by anything, with the right checksum."""
    facts = json.loads((folder / checkpoint.FACTS).read_text())
    (folder / checkpoint.TENSORS).write_bytes(blob)
    (folder / checkpoint.FACTS).write_text(json.dumps({**facts, "sha256": hashlib.sha256(blob).hexdigest()}))


def test_a_kill_between_the_renames_loses_nothing(tmp_path):
    folder = write(tmp_path / "run" / "checkpoints" / "last")
    folder.rename(folder.with_name(".last.old"))  # killed right after this
    assert checkpoint.read(locate(tmp_path / "run", prefer="last"))[1]["frames"] == 1
    write(folder, frames=2)
    assert checkpoint.read(locate(tmp_path / "run", prefer="last"))[1]["frames"] == 2
    assert [path.name for path in folder.parent.iterdir()] == ["last"]


def test_a_new_checkpoint_and_its_name_reach_the_disk(tmp_path, monkeypatch):
    """A power failure after ``write`` must not bring the older one back, or a folder without its files."""
    folder, synced = write(tmp_path / "last"), []

    def fsync(descriptor):
        found = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        synced.append(str(found.relative_to(tmp_path)))

    monkeypatch.setattr(os, "fsync", fsync)
    write(folder, frames=2)
    assert synced == [f".last.new/{checkpoint.TENSORS}", f".last.new/{checkpoint.FACTS}", ".last.new", "."]


def test_locate_knows_runs_and_checkpoints(tmp_path):
    saved = tmp_path / "checkpoints"
    for name in ("best", "last", "previous"):
        checkpoint.write(saved / name, {}, {})
    assert locate(tmp_path).name == "best"
    assert locate(tmp_path, prefer="last").name == "last"
    assert locate(saved / "last").name == "last"
    with pytest.raises(CheckpointError, match="no checkpoint there"):
        locate(tmp_path / "elsewhere")
    shutil.rmtree(saved / "last")
    assert locate(tmp_path, prefer="last").name == "best"
    shutil.rmtree(saved / "best")
    with pytest.raises(CheckpointError, match="no best checkpoint there; expected checkpoint=.*/previous"):
        locate(tmp_path)


def test_a_reader_that_comes_between_the_files_reads_again(tmp_path, monkeypatch):
    folder = write(tmp_path / "last")
    load, calls = checkpoint.load, []

    def replaced(blob):
        calls.append(1)
        if len(calls) == 1:
            write(folder, value=1.0, frames=2)
            raise ValueError("altered")
        return load(blob)

    monkeypatch.setattr(checkpoint, "load", replaced)
    assert checkpoint.read(folder)[1]["frames"] == 2


def test_restore_names_what_does_not_fit():
    def make():
        return torch.nn.Linear(2, 3)

    state = make().state_dict()
    assert torch.equal(checkpoint.restore(make, state, "policy").weight, state["weight"])
    for bad, words in (
        ({"weight": torch.zeros(4, 2)}, r"policy does not fit .* weight is float32 of shape \(4, 2\)"),
        ({"bias": None}, "bias is missing"),
        ({"bias": 3}, "bias is int, expected float32"),
        ({"more": torch.zeros(1)}, "more is not expected"),
        ({"bias": torch.full((3,), float("nan"))}, "policy is of no use: bias holds values.* not finite"),
    ):
        with pytest.raises(CheckpointError, match=words):
            checkpoint.restore(make, {**state, **bad}, "policy")
    with pytest.raises(CheckpointError, match="of shape .3, 2., expected .* of shape .10000000000, 2."):
        checkpoint.restore(lambda: torch.nn.Linear(2, 10**10), state, "policy")  # takes no memory


@pytest.mark.parametrize("name", [checkpoint.FACTS, checkpoint.TENSORS])
def test_links_are_refused_and_a_pipe_does_not_block(tmp_path, name):
    folder = write(tmp_path / "last")
    (folder / name).rename(tmp_path / name)
    (folder / name).symlink_to(tmp_path / name)
    with pytest.raises(CheckpointError, match=f"{folder}/{name}: a folder, link, pipe or device; expected a regular"):
        checkpoint.read(folder)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(CheckpointError, match=f"{folder}/{name}: a folder, link, pipe or device; expected a regular"):
        checkpoint.read(folder)


@pytest.mark.parametrize(
    ("dtype", "shape", "size"),
    [("F4", [2], 1), ("F8_E8M0", [1], 1), ("F32", [0, 2**63], 0), ("F32", [2**62, 2**62], 8), ("F32", [2], 2**40)],
)
def test_tensors_of_absurd_types_and_sizes(tmp_path, dtype, shape, size):
    folder = write(tmp_path / "last")
    header = json.dumps({"policy|x": {"dtype": dtype, "shape": shape, "data_offsets": [0, size]}}).encode()
    write_tensors(folder, struct.pack("<Q", len(header)) + header + bytes(size % 64))
    with pytest.raises(CheckpointError, match="cannot be read") as caught:
        checkpoint.read(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [checkpoint.TENSORS, checkpoint.FACTS, "state.pt", ""])
def test_a_pickle_is_never_run_whatever_its_name(tmp_path, name):
    folder, made = write(tmp_path / "run" / "checkpoints" / "last"), tmp_path / "made"
    blob = f"cos\nsystem\n(S'touch {made}'\ntR.".encode()
    assert pickle.loads(blob) == 0 and made.unlink() is None  # it would
    if name == checkpoint.TENSORS:
        write_tensors(folder, blob)
    elif name:
        (folder / name).write_bytes(blob)
    else:
        shutil.rmtree(folder)
        folder.write_bytes(blob)
    if name == "state.pt":
        checkpoint.read(locate(folder))
    else:
        with pytest.raises(CheckpointError):
            checkpoint.read(locate(folder))
    assert not made.exists()


paths = st.one_of(
    st.sampled_from(["policy", "policy|x", "policy|0", "policy|0|y", "|", "../x"]), st.text("a|0/.", max_size=5)
)
plain = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=6)),
    lambda c: st.one_of(st.lists(c, max_size=3), st.dictionaries(paths, c, max_size=4)),
    max_leaves=8,
)


@settings(max_examples=60)
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
        state, facts = checkpoint.read(locate(folder))
        assert isinstance(state["policy"], dict) and isinstance(facts["config"], dict) and facts["frames"] >= 0
    except CheckpointError as error:
        assert "\n" not in str(error)
    assert {path.name for path in folder.parent.rglob("*")} == {"last", checkpoint.FACTS, checkpoint.TENSORS}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": 99}, "schema 99"), ({"state": None}, "lacks its state"), ({"sha256": "0"}, "or altered"),
        ({"config": []}, "lacks its state, config"), ({"frames": None}, "config or frames"),
        *((text, "cannot be read") for text in (b"[" * 200_000, b'{"a":' * 200_000, b"9" * 10_000, b"\xff", b"")),
    ],
    ids=lambda value: str(value)[:10],
)  # fmt: skip
def test_damaged_facts_are_refused(tmp_path, change, words):
    facts = write(tmp_path / "last") / checkpoint.FACTS
    whole = json.loads(facts.read_text())
    facts.write_bytes(change if isinstance(change, bytes) else json.dumps({**whole, **change}).encode())
    with pytest.raises(CheckpointError, match=words) as caught:
        checkpoint.read(facts.parent)
    assert "\n" not in str(caught.value)
