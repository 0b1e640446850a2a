"""The table and the figure of a sweep, and sweeps by plugins; those that are not installed are skipped."""

import csv
import logging
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import TINY
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from pickplace.config.hydra_app import constant_keys, folder_name, sweep_words
from pickplace.config.words import config_files
from pickplace.runs import checkpoint
from pickplace.runs.folder import FAILURE
from pickplace.training import sweep
from pickplace.training.sweep import group_by_setting, label, read_run, results, summarize

SMOKE = ["experiment=smoke", "threads=1"]


def table(folder, name="sweep.csv"):
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def make_run(folder, name, overrides, occupancies, total=1000, failure=None, ended=""):
    """A run folder as a job of a sweep leaves it, validated every 100 frames."""
    run_dir = folder / name
    (run_dir / ".hydra").mkdir(parents=True)
    OmegaConf.save(overrides, run_dir / ".hydra" / "overrides.yaml")
    OmegaConf.save({"total_frames": total}, run_dir / ".hydra" / "config.yaml")
    rows = [f"{100 * (i + 1)},{mean},{mean - 0.01},{mean + 0.01}" for i, mean in enumerate(occupancies)]
    (run_dir / "metrics.csv").write_text("\n".join(["frames,eval/occupancy,eval/ci95_low,eval/ci95_high", *rows, ""]))
    if failure:
        (run_dir / FAILURE).write_text(failure)
    if ended:
        facts = {"ended": ended, "frames": 100 * len(occupancies), "config": {"total_frames": total}}
        checkpoint.write(run_dir / "checkpoints/last", {}, facts)


def test_the_table_shows_how_every_run_ended(tmp_path):
    make_run(tmp_path, "0", ["algo.lr=0.001", "seed=1"], [0.2, 0.9, 0.8], total=300)
    make_run(tmp_path, "2", ["algo.lr=0.01", "seed=1"], [0.5])
    make_run(tmp_path, "10", ["algo.lr=1", "seed=1"], [], failure="the loss is not finite.\n")
    settings = summarize(tmp_path)
    runs = [each for setting in settings for each in setting.runs]
    found = [(each.name, each.status, each.frames) for each in runs]
    assert found == [("0", "finished", 300), ("2", "stopped", 100), ("10", "failed", 0)]
    assert (runs[0].last["eval/occupancy"], runs[2].last) == (0.8, {})
    labels = [label(each, settings) for each in settings]
    assert labels == ["algo.lr=0.001", "algo.lr=0.01 (1 stopped)", "algo.lr=1 (1 failed)"]
    first, _, last = table(tmp_path)
    assert (first["algo.lr"], first["best_occupancy"], first["final_ci95_low"]) == ("0.001", "0.9", "0.79")
    assert (last["status"], last["best_occupancy"], last["error"]) == ("failed", "", "the loss is not finite.")
    assert is_png(tmp_path / "sweep.png")


def test_settings_are_compared_over_their_seeds(tmp_path, caplog):
    """The best run belongs to the worse setting."""
    caplog.set_level(logging.INFO)
    finals = {"adaptive": [0.1, 0.9, 0.5, 0.6, 0.4], "none": [0.5, 0.7, 0.6], "mixture": [0.3]}
    for name, occupancies in finals.items():
        for seed, final in enumerate(occupancies):
            make_run(tmp_path, f"{name}{seed}", [f"curriculum={name}", f"seed={seed}"], [0.0, final], total=200)
    make_run(tmp_path, "none9", ["seed=9", "curriculum=none"], [0.95], total=200)  # stopped: not counted
    summarize(tmp_path)
    rows = table(tmp_path, "sweep_settings.csv")
    assert [(row["curriculum"], row["runs"], row["finished"]) for row in rows] == [
        ("adaptive", "5", "5"), ("mixture", "1", "1"), ("none", "4", "3"),
    ]  # fmt: skip
    assert [float(row["mean_occupancy"]) for row in rows] == pytest.approx([0.5, 0.3, 0.6])
    middle, *others = [row["interquartile_mean"] for row in rows]
    assert float(middle) == pytest.approx(0.5)  # of 5 without the lowest and the highest one
    assert others == ["", ""]  # fewer than 4
    low, high = (float(rows[0][f"mean_ci95_{end}"]) for end in ("low", "high"))
    assert 0.22 < low < 0.32 and 0.68 < high < 0.78  # 0.5 +- 1.96 * 0.261 / sqrt(5), roughly
    assert (rows[1]["mean_ci95_low"], rows[1]["mean_ci95_high"]) == ("", "")  # one seed
    assert [float(rows[2][f"mean_ci95_{end}"]) for end in ("low", "high")] == pytest.approx([0.5, 0.7])  # the range
    assert "curriculum=none" in caplog.messages[0] and caplog.messages[0].startswith("0.6000  (0.5000 to 0.7000)")
    assert "seed" not in rows[0] and len(table(tmp_path)) == 10


def test_a_seed_that_was_trained_twice_counts_once(tmp_path):
    """By default, and by name."""
    for name, words in {"a": [], "b": ["seed=0"], "c": ["seed=1"]}.items():
        make_run(tmp_path, name, ["algo.lr=1", *words], [0.8 if name < "c" else 0.6], total=100)
    (setting,) = summarize(tmp_path)
    assert (len(setting.runs), len(setting.finished)) == (3, 2) and setting.mean == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("metrics.csv", b"frames,eval/occupancy\n\xff,1\n", "metrics.csv, line 2: got the byte 0xff"),
        ("metrics.csv", b"\0\0", "metrics.csv, line 1: expected a column frames"),
        ("metrics.csv", b"a,b\n", "metrics.csv, line 1: expected a column frames, got 'a,b'"),
        (".hydra/overrides.yaml", b"\xff", "overrides.yaml=None: expected the overrides"),
        (".hydra/overrides.yaml", b"algo.lr=1", "overrides.yaml='algo.lr=1': expected the overrides"),
        (".hydra/overrides.yaml", b"- [3]", "overrides.yaml=[[3]]: expected the overrides"),
        ("failure.txt", b"\xff", "failure.txt, line 1: got the byte 0xff"),
    ],
)
def test_a_run_that_cannot_be_read_leaves_the_others_alone(tmp_path, name, content, words):
    for number in range(3):
        make_run(tmp_path, str(number), [f"algo.lr={number}", "seed=1"], [0.2, 0.4], total=200)
    (tmp_path / "1" / name).write_bytes(content)
    settings = summarize(tmp_path)
    rows = table(tmp_path)
    assert [row["status"] for row in rows] == ["finished", "unreadable", "finished"] and words in rows[1]["error"]
    labels = ["algo.lr=0", "algo.lr=1 (1 unreadable)", "algo.lr=2"]
    if "overrides" in name:  # of no known setting
        del labels[1]
    assert [label(each, settings) for each in settings] == labels and is_png(tmp_path / "sweep.png")


def test_a_sweep_writes_through_no_link(tmp_path):
    make_run(tmp_path / "sweep", "0", [], [0.2], total=100)
    make_run(tmp_path / "sweep", "1", ["algo.lr=1"], [0.2], total=100)
    (tmp_path / "mine").write_text("mine")
    for name in ("sweep.csv", "sweep_settings.csv", "sweep.png"):
        (tmp_path / "sweep" / name).symlink_to(tmp_path / "mine")
    settings = summarize(tmp_path / "sweep")
    assert (tmp_path / "mine").read_text() == "mine" and is_png(tmp_path / "sweep" / "sweep.png")
    assert [label(each, settings) for each in settings] == ["defaults", "algo.lr=1"]


def test_a_curve_is_the_mean_of_runs_that_end_at_different_frames(tmp_path):
    make_run(tmp_path, "0", ["seed=0"], [0.2, 0.4, 0.8], total=300)
    make_run(tmp_path, "1", ["seed=1"], [0.4, 0.6], total=200)  # as after early stopping
    frames, values = group_by_setting([read_run(tmp_path / "0"), read_run(tmp_path / "1")])[0].curves
    assert frames.tolist() == [100, 200, 300] and values.mean(1) == pytest.approx([0.3, 0.5, 0.7])


def test_tables_and_figure_show_seeds_early_ends_and_frames(tmp_path, monkeypatch):
    for seed, (occupancies, ended) in enumerate((([0.2, 0.4, 0.8], ""), ([0.4, 0.6], "perhaps luck"))):
        make_run(tmp_path, str(seed), [f"seed={seed}"], occupancies, total=300, ended=ended)
    make_run(tmp_path, "2", ["seed=2"], [0.5], total=300)
    figures = []
    monkeypatch.setattr(sweep, "save", lambda figure, path: figures.append(figure))
    settings = summarize(tmp_path)
    assert results(settings) == [
        "0.7000  (0.6000 to 0.8000)  2 seeds  200 to 300 frames  all runs (1 ended early, 1 stopped)"
    ]
    assert [row["ended"] for row in table(tmp_path)] == ["", "perhaps luck", ""]
    (row,) = table(tmp_path, "sweep_settings.csv")
    assert [row[key] for key in ("ended_early", "least_frames", "most_frames")] == ["1", "200", "300"]
    (axes,) = figures[0].axes
    drawn = {(line.get_marker(), line.get_linestyle()): line.get_xydata().tolist() for line in axes.lines[:-3]}
    assert drawn == {
        ("None", "-"): [[100, 0.4], [200, 0.6]], ("X", "None"): [[200, 0.6]], (".", "--"): [[100, 0.5]],
        ("o", "-"): pytest.approx(np.array([[100, 0.3], [200, 0.5], [300, 0.7]])),
    }  # fmt: skip
    figures[0].draw_without_rendering()
    assert not axes.get_legend().get_window_extent().overlaps(axes.get_window_extent())


def test_long_overrides_are_told_apart(tmp_path):
    """A list of levels is one word without spaces."""
    for name in "01":
        levels = f"[{'{tote_height:2},' * 9}{{rotations:{name}}}]"
        make_run(tmp_path, name, [f"curriculum.levels={levels}"], [0.5], total=100)
    texts = results(group_by_setting([read_run(tmp_path / name) for name in "01"]))
    assert [text[-13:-2] for text in texts] == ["rotations:0", "rotations:1"]
    assert all("curriculum.levels=[{tote_height:2}" in text and len(text) < 190 for text in texts)


def test_a_single_run_is_drawn_with_the_interval_of_its_episodes(tmp_path, monkeypatch):
    make_run(tmp_path, "0", [], [0.2, 0.4], total=200)
    figures = []
    monkeypatch.setattr(sweep, "save", lambda figure, path: figures.append(figure))
    summarize(tmp_path)
    [band] = figures[0].axes[0].collections
    corners = band.get_paths()[0].vertices
    assert (corners[:, 1].min(), corners[:, 1].max()) == pytest.approx((0.19, 0.41))


def test_a_sweep_over_seeds_ends_in_a_row_for_each_setting(run, tmp_path, no_report):
    """And its folders are named by overrides, seed last; started again, it has nothing to do."""
    command = ["train", "-m", *TINY, "curriculum/sample=current,recent", "hydra.sweep.dir=sweep"]
    code, _, err = run(*command, "seed=0,1")
    assert code == 0, err
    runs, settings = table(tmp_path / "sweep"), table(tmp_path / "sweep", "sweep_settings.csv")
    assert [row["curriculum/sample"] for row in settings] == ["current", "recent"]
    for setting in settings:
        finals = [
            float(row["final_occupancy"]) for row in runs if row["curriculum/sample"] == setting["curriculum/sample"]
        ]
        assert len(finals) == 2 and float(setting["mean_occupancy"]) == pytest.approx(sum(finals) / 2)
        assert min(finals) <= float(setting["mean_ci95_low"]) <= float(setting["mean_ci95_high"]) <= max(finals)
    names = [row["run"] for row in runs]
    assert names == [f"curriculum.sample-{sample}+seed-{seed}" for sample in ("current", "recent") for seed in (0, 1)]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "sweep").glob("*/checkpoints/last/*")}
    assert run(*command, "seed=1")[0] == 0 and len(before) == 8
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "sweep").glob("*/checkpoints/last/*")} == before


def test_names_of_folders():
    words = ["seed=3", "+curriculum/advance=plateau", "algo.lr=1e-3", "planner@warm_start.teacher=mcts"]
    command = [*words[:2], "algo.lr=1e-3,1e-2", words[3]]
    assert constant_keys(command) == ["curriculum/advance", "planner@warm_start.teacher"]
    assert folder_name(words, constant_keys(command)) == "algo.lr-1e-3+seed-3"
    assert folder_name(words[:2], []) == "curriculum.advance-plateau+seed-3"
    assert folder_name(["experiment=quick"], ["experiment"]) == "experiment-quick"
    odd = ["items.path=/data/my items.csv", "items.kinds=[[1,1,1],[2,1,1]]", "a=../..", f"x={'y' * 300}", "é='='"]
    odd += ["a=[1,[2]]", "a=[[1],2]", "env.tote_size=[6,6,5]"]
    names = [folder_name(words, []) for words in ([], odd, *([word] for word in odd))]
    assert len(set(names)) == len(names)
    for name in names:
        assert re.fullmatch(r"\w[\w.+-]+", name, re.ASCII) and len(name) < 200 and ".." not in name
        path = f"outputs/sweep/{name}"
        assert OverridesParser.create().parse_override(f"checkpoint={path}").value() == path


@pytest.mark.parametrize(("sweeper", "numbered"), [("hydra._internal.BasicSweeper", False), ("optuna.Sweeper", True)])
def test_a_sweeper_that_draws_values_numbers_its_runs(sweeper, numbered, monkeypatch):
    """It may draw the same values twice."""
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    words = [f"hydra.sweeper._target_={sweeper}", "seed=1"]
    with config_files():
        settings = sweep_words(compose("train", words, return_hydra_config=True), words)
        job = compose("train", [*settings, *words, "hydra.job.num=3"], return_hydra_config=True)
    HydraConfig.instance().set_config(job)
    assert job.hydra.sweep.subdir == ("3" if numbered else "seed-1")


def test_a_sweep_of_many_runs_and_one_of_none(tmp_path):
    for number in range(42):  # the figure names 40
        make_run(tmp_path, str(number), [f"algo.lr={number}"], [number / 50], total=100 + 100 * (number % 2))
    assert len(summarize(tmp_path)) == 42 and is_png(tmp_path / "sweep.png")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="empty: no run in it"):
        summarize(tmp_path / "empty")


def test_a_run_without_metrics_is_known_by_its_checkpoint(smoke_run, tmp_path):
    """Also when it was resumed with more frames and stopped: then it is not finished."""
    make_run(tmp_path, "0", ["seed=1"], [], total=512)
    shutil.copytree(smoke_run, tmp_path / "0", dirs_exist_ok=True)
    (tmp_path / "0" / "metrics.csv").unlink()
    state, facts = checkpoint.read(tmp_path / "0/checkpoints/last")
    found = read_run(tmp_path / "0")
    assert (found.status, found.frames) == ("finished", 512)
    assert found.last["eval/occupancy"] == facts["latest"]["occupancy"]
    facts["config"]["total_frames"], facts["best"] = 4096, 0.97
    checkpoint.write(tmp_path / "0/checkpoints/last", state, facts)
    found = read_run(tmp_path / "0")
    assert (found.status, found.best) == ("stopped", 0.97)  # not the latest, which is worse


def test_a_run_that_fails_leaves_the_others_alone(run, tmp_path, no_report):
    quick = ["total_frames=128", "evaluation.episodes=2"]
    code, _, err = run("train", "-m", *SMOKE, *quick, "reward_scale=1e38,1", "hydra.sweep.dir=sweep")
    assert code == 2 and "error: run reward_scale-1e+38: the loss or its gradient is not finite" in err
    finished, failed = table(tmp_path / "sweep")
    assert failed["status"] == "failed" and failed["error"].startswith("the loss or its gradient is not finite")
    assert (finished["status"], finished["frames"]) == ("finished", "128")
    assert 0 <= float(finished["final_occupancy"]) <= float(finished["best_occupancy"]) <= 1


@pytest.mark.parametrize(
    ("choice", "extra"),
    [("sweeper=optuna", "optuna"), ("launcher=joblib", "joblib"), ("launcher=submitit_slurm", "submitit")],
)
def test_a_missing_plugin_is_one_sentence(choice, extra, run):
    if any(any(Path(place).glob(f"hydra_plugins/hydra_{extra}*")) for place in sys.path):
        pytest.skip("it is installed")
    code, _, err = run("train", "-m", *SMOKE, f"hydra/{choice}")
    assert code == 2 and err.strip().endswith(f"{extra} is missing; pip install 'pickplace[{extra}]'.")


def test_optuna_maximises_the_occupancy(run, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    settings = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "hydra.sweep.dir=sweep", "total_frames=256"]
    code, out, err = run("train", "-m", *SMOKE, *settings, "algo.lr=interval(0.0001,0.01)")
    assert code == 0, err
    assert "Directions: ['maximize']" in out
    rows = table(tmp_path / "sweep")
    best = OmegaConf.load(tmp_path / "sweep" / "optimization_results.yaml")
    assert len(rows) == 2 and len({row["algo.lr"] for row in rows}) == 2
    assert best.best_value == pytest.approx(max(float(row["final_occupancy"]) for row in rows))
    assert is_png(tmp_path / "sweep" / "sweep.png")


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_launchers_in_other_processes(launcher, run, tmp_path):
    extra = launcher.partition("_")[0]
    pytest.importorskip(f"hydra_plugins.hydra_{extra}_launcher")
    settings = ["total_frames=256", "evaluation.episodes=2", "hydra.sweep.dir=sweep", f"hydra/launcher={launcher}"]
    own = "hydra.launcher.n_jobs=2" if extra == "joblib" else "hydra.launcher.timeout_min=5"
    code, _, err = run("train", "-m", *SMOKE, *settings, own, "reward_scale=1")
    assert code == 0, err
    (row,) = table(tmp_path / "sweep")
    assert (row["status"], row["frames"], row["reward_scale"]) == ("finished", "256", "1")
