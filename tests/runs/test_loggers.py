"""Loggers: metrics survive a killed run, and every backend goes on after a resume."""

import csv
import json
import sys

import pytest

from pickplace.runs.loggers import CsvLogger, read_csv
from pickplace.training.train import resume_run


@pytest.mark.parametrize("row", ["xyz,1", ",2", "inf,1", "1,2,3"])
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


class JsonLines(CsvLogger):
    """A user's logger, which writes a file of its own beside the table."""

    def __init__(self, folder, frames=0, settings=None):
        super().__init__(folder, frames, settings)
        self.path = folder / "metrics.jsonl"
        self.file = self._file = self.path.open("a")

    def log(self, metrics, frames):
        super().log(metrics, frames)
        self.file.write(json.dumps({"frames": frames, **metrics}) + "\n")

    def close(self):
        super().close()
        self.file.close()


def test_a_logger_with_a_file_of_its_own(tmp_path, caplog):
    logger, rows = JsonLines(tmp_path), [{"a": 1.0}, {"a": 2.0, "b": 5.0}]
    for number, row in enumerate(rows, start=1):
        logger.log(row, number)
    logger.close()
    written = [{"frames": number, **row} for number, row in enumerate(rows, start=1)]
    assert read_csv(tmp_path / "metrics.csv") == written and not caplog.records
    assert [json.loads(line) for line in logger.path.read_text().splitlines()] == written


def test_a_resumed_table_has_the_same_bytes(tmp_path):
    """Whole numbers stay whole, and new columns come in the same order."""
    batches = [{"a": 4, "b": 0.1}, {"a": 1e-7, "b": 2.0}, {"c": 10**17, "a": 3}, {"b": -0.0, "d": 1 / 3}, {"a": 5}]
    for name, killed_after in (("whole", None), ("killed", 4)):
        (tmp_path / name).mkdir()
        logger = CsvLogger(tmp_path / name)
        for number, metrics in enumerate(batches):
            if number == killed_after:
                logger.close()
                number_of_checkpoint = 2
                logger = CsvLogger(tmp_path / name, frames=10 * number_of_checkpoint)
                for again in range(number_of_checkpoint, number):
                    logger.log(batches[again], 10 * (again + 1))
            logger.log(metrics, 10 * (number + 1))
        logger.close()
    whole, killed = ((tmp_path / name / "metrics.csv").read_bytes() for name in ("whole", "killed"))
    assert whole == killed and b"\n10,4,0.1,," in whole


@pytest.mark.parametrize("damage", ["delete", "replace", "cut", "folder"])
@pytest.mark.parametrize("when", ["row", "column", "close"])
def test_a_table_that_is_taken_away_is_written_again(tmp_path, caplog, damage, when):
    path = tmp_path / "run" / "metrics.csv"
    path.parent.mkdir()
    logger = CsvLogger(path.parent)
    logger.log({"a": 1.0}, 10)
    logger.log({"a": 2.0}, 20)
    if damage == "cut":
        path.write_text("")
    elif damage == "folder":
        path.parent.rename(tmp_path / "moved")
    else:
        path.unlink()
        if damage == "replace":
            path.write_text("frames,a\n7,7\n")
    rows = [] if damage == "cut" else [{"frames": 10, "a": 1.0}, {"frames": 20, "a": 2.0}]
    if when != "close":
        more = {"a": 3.0} if when == "row" else {"a": 3.0, "b": 4.0}
        for frames in (30, 40):
            logger.log(more, frames)
        rows += [{"frames": frames, **more} for frames in (30, 40)]
    logger.close()
    assert read_csv(path) == rows
    assert len(caplog.messages) == 1 and str(path) in caplog.text


def test_a_disk_that_is_full_for_a_new_column(tmp_path, monkeypatch):
    logger = CsvLogger(tmp_path)
    logger.log({"a": 1.0}, 10)
    with monkeypatch.context() as full:
        full.setattr(csv.DictWriter, "writeheader", lambda _: (_ for _ in ()).throw(OSError(28, "No space left")))
        with pytest.raises(OSError, match="No space left.*metrics.csv"):
            logger.log({"b": 1.0}, 20)
    logger.close()
    assert read_csv(tmp_path / "metrics.csv") == [{"frames": 10, "a": 1.0}]


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow"])
def test_a_missing_extra_is_one_sentence(smoke, name, tmp_path, monkeypatch):
    for module in ("tensorboard", "wandb", "mlflow", "torch.utils.tensorboard"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=rf"^logger={name}: {name} is missing; pip install 'pickplace\[{name}\]'\.$"):
        smoke(tmp_path / "run", f"logger={name}")
    assert not (tmp_path / "run" / "metrics.csv").exists()


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow"])
def test_a_logger_goes_on_after_a_resume_beside_metrics_csv(smoke, name, tmp_path, no_report):
    pytest.importorskip(name)
    run_dir = tmp_path / "run"
    smoke(run_dir, f"logger={name}", "total_frames=256", "evaluation_interval=512")
    ids = [(run_dir / f"{name}_run_id").read_text()] if name != "tensorboard" else []
    resume_run([f"resume={run_dir}", "total_frames=512"])
    rows = read_csv(run_dir / "metrics.csv")
    assert [row["frames"] for row in rows] == [128, 256, 384, 512]
    if ids:
        assert (run_dir / f"{name}_run_id").read_text() == ids[0]
    if name == "wandb":
        folders = list((run_dir / "wandb").glob(f"offline-run-*-{ids[0]}"))
        assert all((folder / f"run-{ids[0]}.wandb").stat().st_size > 1000 for folder in folders) and folders
    if name == "mlflow":
        import mlflow

        history = mlflow.MlflowClient(f"sqlite:///{run_dir / 'mlflow.db'}").get_metric_history(ids[0], "train/reward")
        assert [point.step for point in history] == [128, 256, 384, 512]
        assert [point.value for point in history] == pytest.approx([row["train/reward"] for row in rows])
