"""The table and the figure of a sweep, and sweeps by plugins; those that are not installed are skipped."""

import csv
import shutil
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.training.sweep import label, read_run, summarize

SMOKE = ["experiment=smoke", "threads=1"]


def table(folder):
    with (folder / "sweep.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def is_png(path):
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def make_run(folder, name, overrides, occupancies, total=1000, failure=None):
    """A run folder as a job of a sweep leaves it, validated every 100 frames."""
    run_dir = folder / name
    (run_dir / ".hydra").mkdir(parents=True)
    OmegaConf.save(overrides, run_dir / ".hydra" / "overrides.yaml")
    OmegaConf.save({"total_frames": total}, run_dir / ".hydra" / "config.yaml")
    rows = [f"{100 * (i + 1)},{mean},{mean - 0.01},{mean + 0.01}" for i, mean in enumerate(occupancies)]
    (run_dir / "metrics.csv").write_text("\n".join(["frames,eval/occupancy,eval/ci95_low,eval/ci95_high", *rows, ""]))
    if failure:
        (run_dir / config.FAILURE).write_text(failure)


def test_the_table_shows_how_every_run_ended(tmp_path):
    make_run(tmp_path, "0", ["algo.lr=0.001", "seed=1"], [0.2, 0.9, 0.8], total=300)
    make_run(tmp_path, "2", ["algo.lr=0.01", "seed=1"], [0.5])
    make_run(tmp_path, "10", ["algo.lr=1", "seed=1"], [], failure="the loss is not finite.\n")
    runs = summarize(tmp_path)
    found = [(each.name, each.status, each.frames) for each in runs]
    assert found == [("0", "finished", 300), ("2", "stopped", 100), ("10", "failed", 0)]
    assert (runs[0].best, runs[0].final, runs[2].best) == (0.9, 0.8, None)
    labels = [label(each, runs) for each in runs]
    assert labels == ["algo.lr=0.001", "algo.lr=0.01 (stopped)", "algo.lr=1 (failed)"]
    first, _, last = table(tmp_path)
    assert (first["algo.lr"], first["best_occupancy"], first["final_ci95_low"]) == ("0.001", "0.9", "0.79")
    assert (last["status"], last["best_occupancy"], last["error"]) == ("failed", "", "the loss is not finite.")
    assert is_png(tmp_path / "sweep.png")


def test_a_sweep_of_many_runs_and_one_of_none(tmp_path):
    for number in range(42):  # the figure names 40
        make_run(tmp_path, str(number), [f"seed={number}"], [number / 50])
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
    assert (found.status, found.frames, found.final) == ("finished", 512, facts["latest"]["occupancy"])
    facts["config"]["total_frames"] = 4096
    checkpoint.write(tmp_path / "0/checkpoints/last", state, facts)
    assert read_run(tmp_path / "0").status == "stopped"


def test_a_run_that_fails_leaves_the_others_alone(run, tmp_path):
    quick = ["total_frames=128", "evaluation.episodes=2"]
    code, _, err = run("train", "-m", *SMOKE, *quick, "algo.reward_scale=1e38,1", "hydra.sweep.dir=sweep")
    assert code == 2 and "error: run 0: the loss or its gradient is not finite" in err
    failed, finished = table(tmp_path / "sweep")
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
    code, _, err = run("train", "-m", *SMOKE, *settings, own, "algo.reward_scale=1")
    assert code == 0, err
    (row,) = table(tmp_path / "sweep")
    assert (row["status"], row["frames"], row["algo.reward_scale"]) == ("finished", "256", "1")
