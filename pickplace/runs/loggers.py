"""Where metrics go (config group ``logger``). Names: ``train/...``, ``eval/...``, ``curriculum/...``, ``time/...``.

Whatever is chosen, ``metrics.csv`` is written: reports, figures and sweeps read it.
"""

import csv
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from pickplace.runs.hydra_app import missing_extra

if TYPE_CHECKING:
    from torchrl.record.loggers.common import Logger


class CsvLogger:
    """One table, ``metrics.csv``, a row for each batch and a column for each metric; the first column is ``frames``.

    A new metric adds a column. After a resume the table goes on where the checkpoint left off: rows beyond it, which a
    killed run may have left, are dropped.

    Args:
        folder: the run folder.
        frames: frames already trained; 0 for a new run.
        settings: the run's config, for backends that show it beside the curves.
    """

    def __init__(self, folder, frames: int = 0, settings: dict | None = None):
        self.path = Path(folder) / "metrics.csv"
        self._columns = ["frames"]
        earlier = read_csv(self.path) if frames and self.path.is_file() else []
        self._rewrite([row for row in earlier if row["frames"] <= frames])

    def _rewrite(self, rows):
        """Begin the file anew, with columns for all that these rows hold."""
        self._columns += [key for key in dict.fromkeys(key for row in rows for key in row) if key not in self._columns]
        fresh = self.path.with_name(".metrics.csv.new")
        with fresh.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(rows)
        fresh.replace(self.path)
        self._file = self.path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, self._columns)

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Add a row.

        Raises:
            OSError: naming the file, if it cannot be written.
        """
        row = {"frames": frames, **metrics}
        try:
            if set(row) <= set(self._columns):
                self._writer.writerow(row)
                self._file.flush()
            else:
                self._file.close()
                self._rewrite([*read_csv(self.path), row])
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Close the file; what a full disk did not take is lost."""
        with suppress(OSError):
            self._file.close()


class TensorboardLogger(CsvLogger):
    """TensorBoard event files in the run folder; needs the extra ``pickplace[tensorboard]``. Args as `CsvLogger`."""

    def __init__(self, folder, frames: int = 0, settings: dict | None = None):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise missing_extra("logger", "tensorboard") from error
        super().__init__(folder, frames)
        # Events after the checkpoint that a run is resumed from are hidden by TensorBoard itself.
        self._events = SummaryWriter(str(folder), purge_step=frames + 1 if frames else None)

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Add a point to each metric's curve."""
        super().log(metrics, frames)
        for key, value in metrics.items():
            self._events.add_scalar(key, value, frames)

    def close(self) -> None:
        """Flush and close the event file."""
        super().close()
        self._events.close()


class BackendLogger(CsvLogger):
    """A logger of TorchRL's, made by subclasses as ``_backend``, beside the table. Args as `CsvLogger`."""

    _backend: "Logger"

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Add a point to each metric's curve."""
        super().log(metrics, frames)
        self._backend.log_metrics(metrics, step=frames)


class WandbLogger(BackendLogger):
    """Weights & Biases, through TorchRL's logger; needs the extra ``pickplace[wandb]``.

    The run's id is kept in the run folder, ``wandb_run_id``, so that a resumed run goes on under it.

    Args:
        folder, frames, settings: as of `CsvLogger`.
        project: the project to which the run belongs.
        offline: keep everything in the run folder; ``wandb sync`` sends it later.
    """

    def __init__(
        self,
        folder,
        frames: int = 0,
        settings: dict | None = None,
        project: str = "pickplace",
        offline: bool = True,
    ):
        try:
            import wandb  # noqa: F401
        except ImportError as error:
            raise missing_extra("logger", "wandb") from error
        from torchrl.record.loggers.wandb import WandbLogger as Backend

        super().__init__(folder, frames)
        place = Path(folder) / "wandb_run_id"
        self._backend = Backend(
            Path(folder).name,
            offline=offline,
            save_dir=str(folder),
            id=_run_id(place, frames),
            project=project,
            log_env_packages=False,  # they hold paths of this machine; a checkpoint tells the versions that matter
            settings={"silent": offline, "console": "off"},
        )
        place.write_text(self._backend.experiment.id)
        if settings:
            self._backend.log_hparams(settings)

    def close(self) -> None:
        """Finish the run."""
        super().close()
        self._backend.experiment.finish()


class MlflowLogger(BackendLogger):
    """MLflow, through TorchRL's logger; needs the extra ``pickplace[mlflow]``.

    The run's id is kept in the run folder, ``mlflow_run_id``, so that a resumed run goes on under it.

    Args:
        folder, frames, settings: as of `CsvLogger`.
        experiment: the experiment to which the run belongs.
        uri: where MLflow keeps it, a database or a server; None: ``mlflow.db`` in the run folder.
    """

    def __init__(
        self,
        folder,
        frames: int = 0,
        settings: dict | None = None,
        experiment: str = "pickplace",
        uri: str | None = None,
    ):
        try:
            import mlflow
        except ImportError as error:
            raise missing_extra("logger", "mlflow") from error
        from torchrl.record.loggers.mlflow import MLFlowLogger as Backend

        super().__init__(folder, frames)
        folder = Path(folder).absolute()
        place = folder / "mlflow_run_id"
        local = {} if uri else {"artifact_location": (folder / "mlflow_artifacts").as_uri()}
        before = os.environ.pop("MLFLOW_RUN_ID", None)
        if run_id := _run_id(place, frames):
            os.environ["MLFLOW_RUN_ID"] = run_id  # TorchRL's logger hands no id on; MLflow itself looks here
        try:
            self._backend = Backend(experiment, uri or f"sqlite:///{folder / 'mlflow.db'}", **local)
        finally:
            os.environ.pop("MLFLOW_RUN_ID", None)
            if before is not None:
                os.environ["MLFLOW_RUN_ID"] = before
        place.write_text(self._backend.experiment.info.run_id)
        self._end_run = mlflow.end_run
        if not run_id:
            mlflow.set_tag("mlflow.runName", folder.name)
            if settings:  # MLflow refuses other values later, and a resumed run may have some
                self._backend.log_hparams(settings)

    def close(self) -> None:
        """End the run."""
        super().close()
        self._end_run()


class NoLogger:
    """Keeps nothing. Args as `CsvLogger`."""

    def __init__(self, folder=None, frames: int = 0, settings: dict | None = None):
        pass

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Forget the metrics."""

    def close(self) -> None:
        """Nothing to close."""


def _run_id(place: Path, frames: int) -> str | None:
    """The id under which a resumed run goes on, if there is one."""
    return place.read_text() if frames and place.is_file() else None


def read_csv(path) -> list[dict[str, float]]:
    """The complete rows of a ``metrics.csv``; a metric that a row lacks is left out.

    Raises:
        ValueError: naming the file and the line, where something is no number.
    """
    with Path(path).open(newline="") as file:
        text = file.read()
    lines = text[: text.rfind("\n") + 1].splitlines()  # a killed run may have cut the last line short
    rows = []
    for number, row in enumerate(csv.DictReader(lines), start=2):
        try:
            rows.append({key: float(value) for key, value in row.items() if value})
            rows[-1]["frames"] = int(rows[-1]["frames"])
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise ValueError(f"{path}, line {number}: expected a number in each column ({error}).") from error
    return rows
