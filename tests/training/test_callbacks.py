"""Callbacks: when they are called, how they end a training, and that a resume goes on with their state."""

import json
import logging
import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import after_batch, assert_same

from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv
from pickplace.training.callbacks import Callback, EarlyStopping, make_callbacks
from pickplace.training.sweep import read_run
from pickplace.training.train import resume_run

EXAMPLE = Path(__file__).parents[2] / "docs/examples/own_callback"
CALLED: list[tuple] = []


class Recorder(Callback):
    """Notes its calls, counts batches, and ends the training after so many."""

    def __init__(self, last: int = 10**6):
        self.last, self.batches = last, 0

    def on_batch(self, trainer, metrics):
        self.batches += 1
        metrics["train/recorded"] = self.batches
        CALLED.append(("batch", trainer.frames, "train/grad_norm" in metrics))
        if self.batches == self.last:
            trainer.end("enough")

    def on_validation(self, trainer, episodes, metrics):
        CALLED.append(("validation", trainer.frames, metrics["eval/occupancy"] == float(episodes.occupancy.mean())))

    def on_level_change(self, trainer, old, new):
        CALLED.append(("level", trainer.frames, (old, new)))

    def state_dict(self):
        return {"batches": self.batches}

    def load_state_dict(self, state):
        self.batches = state["batches"]


class Broken(Callback):
    def __init__(self, state=None, metric=1.0, clear=False, later=None):
        self.state, self.metric, self.clear, self.later = state, metric, clear, later

    def on_batch(self, trainer, metrics):
        self.state = self.state or self.later
        if self.clear:
            metrics.clear()
        metrics["train/broken"] = self.metric

    def state_dict(self):
        return {"state": {1, 2}} if self.state else {}

    def load_state_dict(self, state):
        pass


class Counter:
    def state_dict(self):
        return {"batches": 1}


class Forgetful(Counter, Callback):
    """It saves its state, and does not load it."""


@pytest.fixture(autouse=True)
def forget():
    CALLED.clear()


def words(**settings):
    return (
        "+callbacks.mine={_target_: test_callbacks.Recorder" + "".join(f", {k}: {v}" for k, v in settings.items()) + "}"
    )


def test_callbacks_are_called_at_batches_validations_and_levels(smoke, tmp_path, no_report):
    levels = ["curriculum=paper", "curriculum.advance.frames_per_level=256", "env.tote_size=[4,4,3]"]
    smoke(tmp_path / "run", words(), *levels, "total_frames=512", "evaluation_interval=384")
    assert CALLED == [
        ("batch", 128, True),
        ("level", 256, (1, 2)), ("batch", 256, True),
        ("batch", 384, True), ("validation", 384, True),
        ("level", 512, (2, 3)), ("batch", 512, True), ("validation", 512, True),
    ]  # fmt: skip
    assert [row["train/recorded"] for row in read_csv(tmp_path / "run/metrics.csv")] == [1, 2, 3, 4]


def test_a_training_that_a_callback_ends_is_a_complete_one(smoke, tmp_path, caplog, monkeypatch):
    """It is validated, saved and reported, and only other settings continue it."""
    caplog.set_level(logging.INFO)
    run_dir = tmp_path / "run"
    smoke(run_dir, words(last=2), "total_frames=1024", "evaluation_interval=1024")
    rows = read_csv(run_dir / "metrics.csv")
    assert [row["frames"] for row in rows] == [128, 256] and "eval/occupancy" in rows[-1]
    report = (run_dir / "report.html").read_text()
    assert "Ended before 1,024 frames: enough." in report and "How training episodes ended" not in report
    assert "256 frames: enough" in caplog.text
    monkeypatch.setattr("pickplace.training.trainer.learning_curve", lambda metrics, path, *_: path.touch())
    (run_dir / ".hydra").mkdir()
    (run_dir / ".hydra" / "config.yaml").write_text("total_frames: 1024\n")
    (run_dir / ".hydra" / "overrides.yaml").write_text("[]\n")
    assert read_run(run_dir).status == "finished"
    silent = ["threads=2", "progress_interval=7", "logger._target_=csv"]  # they ask for no more training
    assert resume_run([f"resume={run_dir}", "trust=test_callbacks", *silent]) == rows[-1]["eval/occupancy"]
    assert read_csv(run_dir / "metrics.csv") == rows
    assert "a callback ended this training at 256 frames" in caplog.text
    resume_run([f"resume={run_dir}", "trust=test_callbacks", "total_frames=512"])
    rows = read_csv(run_dir / "metrics.csv")
    assert [(row["frames"], row["train/recorded"]) for row in rows[2:]] == [(384, 3), (512, 4)]


def test_a_resume_goes_on_with_the_state_of_the_callbacks(smoke, tmp_path, no_report):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    with after_batch(3, lambda _: shutil.copytree(whole, killed)):
        smoke(whole, words(last=4), "total_frames=1024", "rollout_length=8", "checkpoint_interval=128")
    resume_run([f"resume={killed}", "trust=test_callbacks"])
    assert_same(whole, killed)
    facts = checkpoint.read(killed / "checkpoints" / "last")[1]
    assert (facts["frames"], facts["callbacks"]) == (256, {"mine": {"batches": 4}})


@pytest.mark.parametrize(("words", "kept"), [([], True), (["evaluation.episodes=3"], False)])
def test_validations_on_other_episodes_are_not_compared(smoke, tmp_path, monkeypatch, no_report, words, kept):
    loaded = []
    monkeypatch.setattr(EarlyStopping, "load_state_dict", lambda self, state: loaded.append(state))
    early = ["callbacks=early_stopping", "callbacks.early_stopping.occupancy=null"]
    smoke(tmp_path, *early, "callbacks.early_stopping.patience=9", "total_frames=128")
    resume_run([f"resume={tmp_path}", "total_frames=256", *words])
    assert bool(loaded) == kept


def test_a_training_that_spends_its_budget_does_not_end_early(smoke, tmp_path, no_report):
    smoke(tmp_path, words(last=2), "total_frames=256")
    assert checkpoint.read(tmp_path / "checkpoints" / "last")[1]["ended"] == ""


class Hook(Callback):
    """Calls a function at each batch."""

    def __init__(self, function):
        self.on_batch = {"numbers": self.numbers, "fail": self.fail, "early": self.early}[function]

    def numbers(self, trainer, metrics):
        metrics |= {"train/solved": True, "train/half": Fraction(1, 2), "train/third": np.float32(0.25)}

    def early(self, trainer, metrics):
        metrics["eval/occupancy"] = 0.125

    def fail(self, trainer, metrics):
        [][3]


def hook(function):
    return f"+callbacks.mine={{_target_: test_callbacks.Hook, function: {function}}}"


def test_whatever_counts_as_a_number_is_logged_as_one(smoke, tmp_path, no_report):
    smoke(tmp_path, hook("numbers"), "total_frames=512", "evaluation_interval=512")
    rows = read_csv(tmp_path / "metrics.csv")
    assert [(row["train/solved"], row["train/half"], row["train/third"]) for row in rows] == [(1, 0.5, 0.25)] * 4
    resume_run([f"resume={tmp_path}", "trust=test_callbacks", "total_frames=640"])


def test_a_callback_that_fails_is_named(smoke, tmp_path):
    with pytest.raises(ValueError, match="^callbacks.mine.on_batch failed: IndexError: list index out of range"):
        smoke(tmp_path, hook("fail"))


class Trainer:
    ended = ""

    def end(self, reason):
        self.ended = reason


def test_a_metric_of_validations_is_logged_by_validations_only(smoke, tmp_path):
    with pytest.raises(ValueError, match="^callbacks.mine.on_batch: it logs eval/occupancy; expected another name"):
        smoke(tmp_path, hook("early"))


@pytest.mark.parametrize(
    ("settings", "occupancies", "ends", "luck"),
    [
        ({"occupancy": 0.5}, [0.1, 0.49, 0.56], 2, False),
        ({"occupancy": 0.5}, [0.1, 0.49, 0.54], 2, True),  # its interval begins at 0.49
        ({"occupancy": 0.9, "patience": 2}, [0.3, 0.2, 0.4, 0.4, 0.1], 4, False),
        ({"patience": 2}, [0.3, 0.4, 0.34, 0.33], 3, True),  # outside the interval of 0.4
        ({"patience": 1}, [0.0, 0.1, 0.1], 2, False),
        ({"patience": 3}, [0.3, 0.2, 0.1], None, False),
    ],
)
def test_early_stopping(settings, occupancies, ends, luck):
    """At an occupancy, or without a better one; the reason says whether it may be luck. Intervals are +- 0.05."""
    trainer, callback = Trainer(), EarlyStopping(**settings)
    found = None
    for number, occupancy in enumerate(occupancies):
        metrics = {"eval/occupancy": occupancy, "eval/ci95_low": max(0, occupancy - 0.05)}
        callback.on_validation(trainer, None, metrics)
        found = number if trainer.ended and found is None else found
        state = json.loads(json.dumps(callback.state_dict()))
        callback = EarlyStopping(**settings)
        callback.load_state_dict(state)
    assert found == ends and ("perhaps luck: a single validation" in trainer.ended) == luck


def test_early_stopping_by_the_command(run, no_report):
    stop = ["callbacks=early_stopping", "callbacks.early_stopping.occupancy=0.1", "total_frames=4096"]
    code, out, err = run("train", "experiment=smoke", "threads=1", *stop, "hydra.run.dir=run")
    assert code == 0 and "256 frames: early stopping: the validation occupancy has reached 0.1" in out, err


@pytest.mark.parametrize(
    ("node", "states", "expected"),
    [
        ({"_target_": "early_stoping"}, {}, "callbacks.mine._target_=early_stoping: .* did you mean 'early_stopping'"),
        ({"_target_": "early_stopping", "ocupancy": 1}, {}, "callbacks.mine.ocupancy: there is no key 'ocupancy'"),
        ({"_target_": "early_stopping"}, {}, "occupancy=None: expected a number"),
        ({"_target_": "early_stopping", "occupancy": 2}, {}, "occupancy=2: expected a number between 0 and 1"),
        ({"_target_": "early_stopping", "patience": 0}, {}, "patience=0: expected a whole number >= 1"),
        ({"occupancy": 0.9}, {}, "callbacks.mine={.*}: expected the settings of a callback, with its _target_"),
        (
            {"_target_": "items/kinds", "kinds": [[1, 1, 1]]},
            {},
            "callbacks.mine=Kinds.*: expected the settings of a callback",
        ),
        (
            {"_target_": "early_stopping", "patience": 1},
            {"mine": {"since": [5]}},
            "callbacks.mine: its state cannot be",
        ),
        ({"_target_": "early_stopping", "patience": 1}, {"mine": [1]}, "callbacks.mine: its state cannot be"),
        ({"_target_": "test_callbacks.Broken", "state": True}, {}, "callbacks.mine: its state .* set is not JSON"),
        ({"_target_": "test_callbacks.Forgetful"}, {}, "Counter has a state_dict without a load_state_dict"),
    ],
)
def test_bad_callbacks_are_one_sentence(node, states, expected):
    with pytest.raises(ValueError, match=expected) as caught:
        make_callbacks({"mine": node}, states)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("metric: many", "callbacks.mine: it logs train/broken='many': expected a number"),
        ("clear: true", "callbacks.mine: it removes train/reward from the metrics"),
        ("later: true", "callbacks.mine: its state cannot be saved .* set is not JSON"),
    ],
)
def test_a_callback_that_breaks_a_training_is_named(smoke, tmp_path, settings, expected):
    with pytest.raises(ValueError, match=expected):
        smoke(tmp_path / "run", f"+callbacks.mine={{_target_: test_callbacks.Broken, {settings}}}")


@pytest.mark.parametrize(
    ("method", "answer", "expected"),
    [
        ("learn", {"train/episodes": 1.0}, "it logs train/episodes, which the training logs itself"),
        ("learn", {"train/loss": torch.tensor(1.0)}, r"it logs train/loss=tensor\(1.\): expected a number"),
        ("learn", {"frames": 1}, "it logs='frames': expected another name"),
        ("learn", None, "its metrics=None: expected {name: number}"),
        ("state_dict", {"0": 1}, "its state: the key='0': expected a whole number, or a text that is no number"),
        ("state_dict", {"a": {"b|c": 1}}, r"its state\|a: the key='b\|c': expected"),
        ("state_dict", {"seen": 1}, "PPO has a state_dict without a load_state_dict; expected both"),
        ("state_dict", {"seen": []}, r"its state\|seen=\[\]: expected nested dicts of tensors, numbers and texts"),
    ],
)
def test_an_algorithm_whose_metrics_or_state_cannot_be_saved_is_refused(
    smoke, tmp_path, monkeypatch, method, answer, expected
):
    """In the first batch or before it, whatever a callback logs."""
    monkeypatch.setattr(f"pickplace.algorithms.ppo.PPO.{method}", lambda *_: answer)
    with pytest.raises(ValueError, match=f"^algo: {expected}"):
        smoke(tmp_path / "run", words())


def test_own_callback(run, monkeypatch, tmp_path, no_report):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    mine = ["--config-dir", str(EXAMPLE), "callbacks=[worst_episode,early_stopping]"]
    mine.append("callbacks.worst_episode.occupancy=0")
    code, out, err = run("train", *mine, "experiment=smoke", "threads=1", "total_frames=4096", "hydra.run.dir=run")
    assert code == 0 and "the worst episode has reached 0 2 times in a row" in out, err
    rows = read_csv(tmp_path / "run" / "metrics.csv")
    assert rows[-1]["frames"] == 512 and 0 < rows[-1]["eval/worst"] <= rows[-1]["eval/occupancy"]
    code, out, _ = run("train", "resume=run", "callbacks.worst_episode.times=4", "trust=own_callback")
    assert code == 0 and "1,024 frames: the worst episode has reached 0 4 times in a row" in out
