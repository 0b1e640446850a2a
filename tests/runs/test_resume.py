"""A run that is killed, stopped and resumed equals one that never was, bit for bit, with either collector."""

import errno
import html
import json
import logging
import multiprocessing
import os
import shutil
import signal

import pytest
import torch
from commands import ITERATION, SETTINGS, after_batch, assert_same, composed
from loky import cpu_count
from long import chaos
from omegaconf import OmegaConf

from pickplace import PickPlaceEnv
from pickplace.config.allowlist import saved_form
from pickplace.envs.saved_state import check_saved_states
from pickplace.runs import checkpoint
from pickplace.runs.folder import OccupiedError, claim, note_failure
from pickplace.runs.locate import locate
from pickplace.runs.loggers import read_csv
from pickplace.runs.resume import STOP_SIGNALS, checkpoint_config, resumed_config
from pickplace.training.train import resume_run, train
from pickplace.training.trainer import Trainer

#: Facts of a checkpoint, beside its config.
SAVED = {"curriculum": {}, "frames": 5, "iteration": 1, "best": 0.5, "latest": {}}
SAVED |= {"callbacks": {}, "ended": "", "commit": None, "versions": {}}


def saved_frames(run_dir):
    return json.loads((locate(run_dir, "last") / checkpoint.FACTS).read_text())["frames"]


def content(run_dir):
    """Return the files of a run folder, except logs."""
    return {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file() and path.suffix != ".log"}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Undisturbed runs with either collector, each with its folder as a kill after iteration 5 leaves it."""
    folder = tmp_path_factory.mktemp("undisturbed")

    def get(collector):
        whole, killed = folder / collector, folder / f"{collector}_killed"
        if not whole.exists():
            whole.mkdir()
            with after_batch(5, lambda _: shutil.copytree(whole, killed)):
                train(composed(*SETTINGS, f"collector={collector}"), whole)
        return whole, killed

    return get


@pytest.mark.parametrize("collector", ["single", "multi_sync"])
def test_a_run_that_is_killed_and_stopped_equals_an_undisturbed_one(collector, undisturbed, tmp_path, no_report):
    whole, killed = undisturbed(collector)
    run_dir = shutil.copytree(killed, tmp_path / "run")
    assert saved_frames(run_dir) == 3 * ITERATION  # two more iterations are lost

    def stop(_):
        """Send SIGTERM to the whole group, like a scheduler."""
        for pid in (*(worker.pid for worker in multiprocessing.active_children()), os.getpid()):
            os.kill(pid, signal.SIGTERM)

    with after_batch(7, stop), pytest.raises(KeyboardInterrupt, match="15"):
        resume_run([f"resume={run_dir}"])
    assert read_csv(run_dir / "metrics.csv")[-1]["frames"] == saved_frames(run_dir) == 7 * ITERATION
    resume_run([f"resume={run_dir}"])
    assert_same(whole, run_dir)
    rows = read_csv(run_dir / "metrics.csv")
    assert [row["frames"] for row in rows] == [ITERATION * (i + 1) for i in range(10)]
    assert [i for i, row in enumerate(rows) if "eval/occupancy" in row] == [3, 7, 9]
    assert rows[0]["curriculum/level"] < rows[-1]["curriculum/level"]  # it really trains


@pytest.mark.parametrize("refill", ["each", pytest.param("batch", marks=pytest.mark.slow)])
def test_several_items_in_the_bin_are_resumed_exactly(refill, tmp_path, no_report):
    several = ["env.bin_items=3", "env.bin_size=[5,5,1]", f"env.refill={refill}", "algo.advantages=gae"]
    several += [f"warm_start.{key}={ITERATION}" for key in ("frames", "critic_frames")]
    several += [f"checkpoint_interval={2 * ITERATION}", f"total_frames={4 * ITERATION}"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    with after_batch(3, lambda _: shutil.copytree(whole, killed)):
        train(composed(*SETTINGS, *several), whole)
    resume_run([f"resume={killed}"])
    assert_same(whole, killed)


@pytest.mark.parametrize("words", [
    ["model.actor.hidden=16"],
    ["model=afterstate_fcn", "model.actor.stem=4", "collector=multi_sync", "collector.workers=2"],
])  # fmt: skip
def test_values_with_a_preview_are_resumed_exactly(words, tmp_path, no_report):
    """And trained with: the values learn from what comes."""
    preview = ["env.preview=3", "env.bin_items=2", "curriculum.levels=[{tote_height: 2, preview: 1}, {}]"]
    preview += ["experiment=afterstate", "curriculum=mixture", "env.tote_size=[5,5,3]", "env.num_envs=8", *words]
    preview += ["rollout_length=8", "algo.minibatch_size=32", "model.actor.filters=4"]
    preview += [f"checkpoint_interval={2 * ITERATION}", f"total_frames={4 * ITERATION}", "evaluation.episodes=4"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    with after_batch(3, lambda _: shutil.copytree(whole, killed)):
        train(composed(*preview), whole)
    resume_run([f"resume={killed}"])
    assert_same(whole, killed)
    state, _ = checkpoint.read(locate(whole, "last"))
    assert state["policy"]["network.waiting.sum.weight"].abs().max() > 0


def test_a_run_killed_before_its_first_last_resumes_from_best(undisturbed, tmp_path, no_report):
    whole, killed = undisturbed("single")
    run_dir = shutil.copytree(killed, tmp_path / "run")
    shutil.rmtree(run_dir / "checkpoints/last")
    resume_run([f"resume={run_dir}"])
    assert_same(whole, run_dir)


@pytest.mark.slow
def test_chaos_in_short(tmp_path):
    """While it starts and while it saves; ``make chaos`` kills it a hundred times, with either collector."""
    settings = ["experiment=smoke", "rollout_length=8", "evaluation.episodes=2", "threads=1"]
    assert sum(chaos.compare(tmp_path, 2, "single", 2, settings).values()) == 2


def test_a_new_run_in_a_used_folder_is_refused(run, smoke_run, tmp_path):
    """Before anything in the folder is changed, Hydra's notes included."""
    whole = shutil.copytree(smoke_run, tmp_path / "run")
    (whole / ".hydra").mkdir()
    (whole / ".hydra" / "config.yaml").write_text("seed: 0")
    before = content(whole)
    code, _, err = run("train", "experiment=smoke", "seed=7", f"hydra.run.dir={whole}")
    sentence = f"error: {whole}: there is a training already; expected another run folder, or resume={whole}."
    assert code == 2 and err.strip().splitlines()[-1] == sentence
    assert content(whole) == before


def test_a_second_process_is_refused(run, smoke_run, tmp_path):
    for run_dir, command in (
        (tmp_path / "new", "hydra.run.dir"),
        (shutil.copytree(smoke_run, tmp_path / "run"), "resume"),
    ):
        run_dir.mkdir(exist_ok=True)
        with claim(run_dir):
            code, _, err = run("train", f"{command}={run_dir}")
        taken = f"{run_dir}: another process is working there; expected another run folder, or to wait for it."
        assert (code, err) == (2, f"error: {taken}\n")


@pytest.mark.parametrize(
    ("name", "opens"), [(".lock", "filelock.FileLock.acquire"), ("train.log", "logging.FileHandler.__init__")]
)
def test_a_folder_in_which_nothing_can_be_written(name, opens, smoke_run, monkeypatch):
    """The sentence names the checkpoint, which can be copied. Root may write anywhere, so the system is pretended."""
    run_dir = smoke_run

    def refuse(*_, **named):
        raise OSError(errno.EROFS, "Read-only file system", str(run_dir / name))

    monkeypatch.setattr(opens, refuse)
    with pytest.raises(ValueError, match="Read-only file system") as caught:
        resume_run([f"resume={run_dir}"])
    assert str(caught.value) == (
        f"{run_dir}/{name}: Read-only file system; expected a place where you may read and write. What was saved "
        f"before is whole: pickplace-train resume={run_dir}/checkpoints/last"
    )


def test_a_job_of_a_sweep_that_is_started_again_goes_on(undisturbed, tmp_path, caplog, no_report):
    """A job goes on after a preemption; with another config it is refused, which is no failure of the run there."""
    caplog.set_level(logging.INFO)
    whole, killed = undisturbed("single")
    job, cfg = shutil.copytree(killed, tmp_path / "seed-0"), composed(*SETTINGS, "collector=single")
    note_failure(job, ValueError("a worker has died"))  # else the sweep's table would call it failed for ever
    train(cfg, job)
    assert f"going on with {job} at {3 * ITERATION} frames" in caplog.text
    assert_same(whole, job)
    cfg.algo.lr = 1e-4
    with pytest.raises(OccupiedError, match="there is a training already") as refused:
        train(cfg, job)
    note_failure(job, refused.value)
    assert not (job / "failure.txt").exists()
    assert_same(whole, job)


def test_a_stopped_training_has_the_exit_code_of_its_signal(run, tmp_path):
    """By the command, and twice when it is resumed; later signals do what they did before."""
    run_dir, handlers = tmp_path / "run", [signal.getsignal(number) for number in STOP_SIGNALS]
    commands = (["experiment=smoke", "threads=1", f"hydra.run.dir={run_dir}"], *2 * [[f"resume={run_dir}"]])
    for batch, (number, words) in enumerate(zip((signal.SIGTERM, signal.SIGINT, signal.SIGHUP), commands, strict=True)):
        with after_batch(batch + 1, lambda _, number=number: os.kill(os.getpid(), number)):
            code, out, _ = run("train", *words)
        assert code == 128 + number and f"continue with: pickplace-train resume={run_dir}\n" in out
        assert saved_frames(run_dir) == (batch + 1) * 128
        assert [signal.getsignal(number) for number in STOP_SIGNALS] == handlers
    assert (run_dir / "learning_curve.png").is_file() and not (run_dir / "report.html").exists()
    assert run("train", f"resume={run_dir}")[0] == 0 and (run_dir / "report.html").is_file()


def test_a_stop_request_ends_a_sweep(run, tmp_path, no_report):
    with after_batch(1, lambda _: os.kill(os.getpid(), signal.SIGINT)):
        code, _, err = run("train", "-m", "seed=0,1", "experiment=smoke", "threads=1", "hydra.sweep.dir=sweep")
    assert code == 130, err
    assert saved_frames(tmp_path / "sweep" / "seed-0") == 128 and not (tmp_path / "sweep" / "seed-1").exists()


def test_a_missing_report_is_written_on_resume(smoke_run, tmp_path, caplog):
    """With the best by the settings of now, which may be of other episodes; but not without a validation."""
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    state, facts = checkpoint.read(last := run_dir / "checkpoints/last")
    checkpoint.write(last, state, {**facts, "best": 0.1234})
    (run_dir / ".hydra").mkdir()
    OmegaConf.save(composed("experiment=smoke", "threads=1", "evaluation_interval=512"), run_dir / ".hydra/config.yaml")
    (run_dir / "report.html").unlink()
    resume_run([f"resume={run_dir}", "algo.epochs=3"])
    text = html.unescape((run_dir / "report.html").read_text())
    assert "\n\nChanged when it was resumed: algo.epochs=3</pre>" in text
    assert "<b>0.1234</b><span>best validation, after 512 frames (checkpoints/best)" in text
    (run_dir / "report.html").unlink()
    (run_dir / "metrics.csv").unlink()  # as after logger=none
    caplog.set_level(logging.INFO)
    resume_run([f"resume={run_dir}"])
    assert not (run_dir / "report.html").exists() and "complete; total_frames above 512 continues it" in caplog.text


@pytest.mark.parametrize("changed", [["algo.lr=0"], []])
def test_a_stale_best_is_replaced_if_the_config_has_changed(changed, smoke_run, tmp_path, monkeypatch, no_report):
    """At the next validation, and not before. With the same config the run comes to that best again."""
    run_dir, before = shutil.copytree(smoke_run, tmp_path / "run"), []
    saved, validate = run_dir / "checkpoints", Trainer.validate
    state, facts = checkpoint.read(saved / "previous")
    checkpoint.write(saved / "previous", state, {**facts, "best": 0.99})
    checkpoint.write(saved / "best", state, {**facts, "frames": 512, "best": 0.995})

    def validate_and_look(*args, **kwargs):
        before.append(checkpoint.read(saved / "best")[1]["best"])
        return validate(*args, **kwargs)

    monkeypatch.setattr(Trainer, "validate", validate_and_look)
    resume_run([f"resume={saved}/previous", *changed])
    assert before[0] == 0.995
    best = checkpoint.read(saved / "best")[1]["best"]
    assert best == pytest.approx(read_csv(run_dir / "metrics.csv")[-1]["eval/occupancy"]) if changed else best == 0.995


def test_a_best_is_compared_on_the_episodes_of_now(smoke_run, tmp_path, no_report):
    """It is validated again if validation changes; training goes on with the weights of ``last``."""
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    saved = run_dir / "checkpoints"
    shutil.rmtree(saved / "best")
    shutil.copytree(saved / "previous", saved / "best")
    state, facts = checkpoint.read(saved / "last")

    def resumed(*words):
        return Trainer(resumed_config("x", facts, [*words]), run_dir, (state, {**facts, "best": 0.99}, saved / "last"))

    imitated = "warm_start.frames=512"  # that is over: the teacher, which is missing, is not asked
    assert resumed("evaluation_interval=1", imitated).best == 0.99
    with pytest.raises(ValueError, match="warm_start.frames=513: expected 0 without a teacher"):
        resumed("warm_start.frames=513")
    trainer = resumed("evaluation.episodes=3")
    for key, value in trainer.policy.state_dict().items():
        assert torch.equal(value, state["policy"][key]), key
    trainer.policy.load_state_dict(checkpoint.read(saved / "best")[0]["policy"])
    assert trainer.best == trainer.validate().occupancy.mean()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.rotations=1", "env.rotations=1: the run began with 4"), ("items.kinds=[[1,1,1]]", "items={"),
        ("env.observation.tote_depth._target_=bin_depth", "env.observation={"),
        ("env.tote_size=[5,5,1]", "the run began with [4, 4, 1]"), ("env.num_envs=4", "the run began with 8"),
        ("model.mask_infeasible=false", "the run began with True"), ("model.actor.filters=16", "does not fit"),
        ("curriculum=paper", "cannot be exchanged; expected overrides of its values, such as curriculum.<key>=<value>, "
         "or a new run, such as one with warm_start.weights=/"), ("+algo.gama=0.9", "did you mean 'gamma'?"),
        ("algo.lr=1,2", "one value"), ("~algo.lr", "<key>=<value>"),
        ("total_frames=100", "total_frames=100: the run has trained 512 frames already; expected more"),
    ],
)  # fmt: skip
def test_a_resume_with_other_settings_is_refused_and_changes_nothing(run, smoke_run, override, message):
    before = content(smoke_run)
    code, _, err = run("train", f"resume={smoke_run}", "total_frames=1024", override)
    assert code == 2 and message in err and err.count("\n") == 1
    assert content(smoke_run) == before


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_a_damaged_checkpoint_is_refused_and_a_whole_one_is_named(smoke_run, tmp_path, damage):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    tensors = run_dir / "checkpoints" / "last" / checkpoint.TENSORS
    blob = bytearray(tensors.read_bytes())
    blob[len(blob) // 2] ^= 1
    tensors.unlink()
    if damage != "remove":
        tensors.write_bytes(blob if damage == "flip" else blob[:-1])
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/best, at 512 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])
    (run_dir / "checkpoints" / "best" / checkpoint.FACTS).unlink()
    with pytest.raises(checkpoint.CheckpointError, match=f"{run_dir}/checkpoints/previous, at 256 frames, is whole.$"):
        resume_run([f"resume={run_dir}"])


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        *(("iteration", value, "checkpoint's iteration") for value in (None, "x", [], 10**30, 2.5)),
        *(("best", value, "checkpoint's best") for value in (None, {}, float("nan"))),
        ("best", 1e18, "best=1e+18: expected a number between -1 and 1"), ("iteration", -1, "iteration=-1"),
        ("latest", {"occupancy": 7}, "occupancy=7: expected a number between 0 and 1"),
        ("curriculum|level", 10**6, "level of the checkpoint=1000000: expected a whole number"),
        ("curriculum|frames", 10**6, "frames=1000000: expected a whole number >= 0 and <= 512"),
        ("curriculum|episodes", 10**6, "episodes of the checkpoint=1000000: expected a whole number"),
        ("curriculum|window", [float("nan")], "window of the checkpoint=nan: expected a number between 0 and 1"),
        ("latest", 3, "latest is 3; expected"),
        ("latest", {"occupancy": [1]}, "occupancy=[1]: expected a number"),
        ("latest", {str(n): 0 for n in range(300_000)}, "expected a validation that a training wrote"),
        ("latest", {"\x1b[31m": 0}, "expected a validation that a training wrote"),
        ("callbacks", 7, "callbacks is 7; expected"), ("ended", True, "ended is True; expected"),
        ("commit", {}, "commit is {}; expected"), ("versions", None, "versions is None; expected"),
        *(
            (f"config|{path}", {"x": 1}, f"in the checkpoint's config, {path.replace('|', '.')}: there is no key")
            for path in ("foo", "evaluation|foo", "warm_start|foo", "hydra")
        ),
        *(("curriculum", value, "curriculum is") for value in (None, "x", 10**30)),
        ("curriculum", {}, "curriculum={}: expected the state that a training saved"),
        ("curriculum|level", 2.5, "level of the checkpoint=2.5: expected a whole number"),
        ("curriculum|frames", -1, "frames=-1: expected a whole number"),
        ("curriculum|window", "abc", "window of the checkpoint='abc': expected a list"),
        ("curriculum|window", [0.5, 7], "window of the checkpoint=7: expected a number between 0 and 1"),
        ("config|algo|foo", 1, "algo.foo: there is no key 'foo' in algo"),
        ("rng", torch.zeros(5056), "rng is float32 of shape (5056,), expected uint8 of shape (5056,)"),
        ("rng", None, "rng is missing, expected uint8"),
        ("rng", torch.zeros(5056, dtype=torch.uint8), "random generator is of no use"),
        ("algorithm|optimizer", None, "has no optimizer"),
        ("algorithm|optimizer", {"zzz": torch.zeros(1)}, "optimizer has 'zzz'; expected numbers below"),
        ("algorithm", None, "has no optimizer"),
        ("algorithm|optimizer|0|step", torch.tensor(float("inf")), "optimizer is of no use: 0|step holds values"),
        ("critic", None, "critic does not fit"),
        ("collector", None, "environment|surface is missing"),
        ("collector|carried|footprint_mask", None, "carried|footprint_mask is missing, expected bool"),
        ("collector|environment|surface", torch.zeros(8, 4, 4), "of shape (8, 4, 4), expected int32"),
        ("policy", torch.zeros(3), "no policy"),
    ],
)  # fmt: skip
def test_a_checkpoint_that_no_training_wrote_is_not_resumed(smoke_run, tmp_path, part, value, words):
    """With the right checksum. The files in the run folder stay as they were."""
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    folder = run_dir / "checkpoints" / "last"
    state, facts = checkpoint.read(folder)
    *parents, leaf = (int(word) if word.isdecimal() else word for word in part.split("|"))
    for node in (facts, state):
        for parent in parents:
            node = node.get(parent, {})
        if leaf in node or part.startswith("config|") and node:
            node[leaf] = value
            if value is None and node is not facts:
                del node[leaf]
    del facts["schema"], facts["sha256"]
    checkpoint.write(folder, state, facts)
    before = content(run_dir)
    with pytest.raises(ValueError) as caught:
        resume_run([f"resume={run_dir}", "total_frames=1280"])
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert content(run_dir) == before


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda saved: saved["item"].select(2, 0).fill_(5), "item: expected items inside the bin"),
        (lambda saved: saved["item"].select(2, 4).fill_(9), "item: expected sizes of the distribution"),
        (lambda saved: saved["item"].copy_(saved["item"][:, :1].expand(-1, 2, -1)), "item: expected items that do not"),
        (lambda saved: saved["arrived"].add_(1), "arrived: expected the items placed and those in the bin"),
        (lambda saved: saved["coming"].copy_(saved["coming"].flip(1)), "coming: expected the next items of this"),
    ],
)
def test_a_bin_that_no_episode_leads_to_is_refused(change, words):
    env = PickPlaceEnv(num_envs=4, bin_items=2, preview=3)
    carried = env.reset()
    saved = {"environment": {key: value.clone() for key, value in env.state_dict().items()}, "carried": carried}
    check_saved_states(env, saved)
    change(saved["environment"])
    with pytest.raises(checkpoint.CheckpointError, match=f"of no use: {words}"):
        check_saved_states(env, saved)


@pytest.mark.parametrize(
    ("key", "value", "local"),
    [
        ("collector.address", "ray://192.0.2.1:1", "local"), ("logger.uri", "http://192.0.2.1", "null"),
        ("logger.offline", False, "true"),
    ],
)  # fmt: skip
def test_the_user_repeats_settings_that_leave_the_machine(key, value, local):
    config = saved_form(composed("experiment=quick", f"++{key}={value}"))
    facts = {"config": config, **SAVED}
    with pytest.raises(ValueError, match=f"{key}={value}: the checkpoint would write outside .* or {key}={local}"):
        resumed_config("run", facts, [])
    assert OmegaConf.select(resumed_config("run", facts, [f"{key}={local}"]), key) != value
    _, words = checkpoint_config(OmegaConf.create(config))  # the words that a stopped run prints are enough
    assert OmegaConf.select(resumed_config("run", facts, words.split()), key) == value


def test_a_checkpoint_asks_for_no_more_threads_than_there_are(caplog):
    """A user may."""
    config = saved_form(composed("experiment=quick", "threads=1024"))
    facts = {"config": config, **SAVED}
    assert resumed_config("run", facts, []).threads == cpu_count() and "threads=1024" in caplog.text
    assert resumed_config("run", facts, ["threads=1024"]).threads == 1024


def test_a_resumed_run_keeps_its_levels():
    facts = {"config": saved_form(composed("experiment=quick", "curriculum.levels=[{tote_height: 2},{}]")), **SAVED}
    with pytest.raises(ValueError, match=r"curriculum.levels=\[\{\}\]: the run began with .* expected a new run"):
        resumed_config("run", facts, ["curriculum.levels=[{}]"])
    with pytest.raises(ValueError, match="curriculum.end_height=3: the run began with .* expected a new run"):
        resumed_config(
            "run", {"config": saved_form(composed("experiment=quick")), **SAVED}, ["curriculum.end_height=3"]
        )


def test_only_the_user_says_what_to_trust():
    config = {**saved_form(composed("experiment=quick")), "trust": ["evil"]}
    facts = {"config": config, **SAVED}
    assert resumed_config("run", facts, []).trust == []
    assert resumed_config("run", facts, ["trust=[mine]"]).trust == ["mine"]
