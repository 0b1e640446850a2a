"""Loggers of metrics (config group ``logger``), named ``train/...``, ``eval/...``, ``curriculum/...`` and ``time/...``.

All but ``logger=none`` write ``metrics.csv``, which reports, figures and sweeps read.
"""

import csv
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from numbers import Real
from pathlib import Path
from typing import IO, Any

from pickplace.common.errors import require_extra
from pickplace.common.files import read_text, replaced_file
from pickplace.common.validate import excerpt, expect, refuse_if, reword_errors

log = logging.getLogger(__name__)


def check_metrics(owner: str, metrics: Any) -> None:
    """Refuse metrics that no logger can write.

    Raises:
        ValueError: naming the ``owner``, the setting whose code has logged them.
    """
    expect(isinstance(metrics, dict), f"{owner}: its metrics", metrics, "{name: number}")
    for key, value in metrics.items():
        expect(isinstance(key, str) and key != "frames", f"{owner}: it logs", key, "another name")
        expect(isinstance(value, Real), f"{owner}: it logs {key}", value, "a number")


class CsvLogger:
    """A table, ``metrics.csv``: a row for each batch, a column ``frames``, and a column for each metric.

    A new metric adds a column. A killed run may have left rows after its checkpoint; a resume drops them. A table that
    is deleted or replaced during training is written again, with all rows.

    Args:
        folder: the run folder.
        frames: frames trained so far; 0 for a new run.
        settings: the run's config, for backends that show it with the curves.
    """

    def __init__(self, folder, frames: int = 0, settings: dict | None = None):
        # Two underscores: a user's logger may have a path or a file of its own.
        self.__path, self.__columns = Path(folder) / "metrics.csv", ["frames"]
        earlier = read_rows(self.__path) if frames and self.__path.is_file() else []
        self._rewrite([row for row in earlier if int(float(row["frames"])) <= frames])

    def _rewrite(self, rows):
        self.__columns = [*dict.fromkeys([*self.__columns, *(key for row in rows for key in row)])]
        with replaced_file(self.__path) as new, new.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.__columns)
            writer.writeheader()
            writer.writerows(rows)
        self.__file: IO[str] = self.__path.open("a+", newline="")  # readable, also after its name is gone
        self.__writer = csv.DictWriter(self.__file, self.__columns)

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Add a row.

        Raises:
            OSError: naming the file, if it cannot be written.
        """
        row = {"frames": frames, **metrics}
        with reword_errors(OSError, lambda error: OSError(error.errno, error.strerror, str(self.__path))):
            self._restore()
            if set(row) <= set(self.__columns):
                self.__writer.writerow(row)
                self.__file.flush()
            else:
                self._rewrite([*self._closed_rows(), row])

    def _closed_rows(self) -> list[dict[str, str]]:
        with self.__file as file:
            file.seek(0)
            return read_rows(self.__path, file.read())

    def _restore(self) -> None:
        """Write the table again, with a warning, if its path no longer leads to the open file, or the file was cut."""
        ours = os.fstat(self.__file.fileno())
        with suppress(FileNotFoundError):
            if os.path.samestat(ours, self.__path.stat()) and ours.st_size >= self.__file.tell():
                return
        log.warning("%s was deleted, replaced or cut while the training writes it; it is written again", self.__path)
        self.__path.parent.mkdir(parents=True, exist_ok=True)
        self._rewrite(self._closed_rows())

    def close(self) -> None:
        """Close the file; rows that a full disk did not take are lost."""
        with suppress(OSError, ValueError):  # a ValueError if a full disk has closed it
            self._restore()
        with suppress(OSError):
            self.__file.close()


class BackendLogger(CsvLogger):
    """A backend beside the table. Subclasses define ``_send``, which sends metrics, and ``_end_run``, which ends a run.

    A resumed run keeps its id, if the backend has ids; a file in the run folder stores it.

    Args:
        folder, frames: as in `CsvLogger`.
        id_file: name of this file.
    """

    _send: Callable[[dict[str, float], int], Any]
    _end_run: Callable[[], Any]

    def __init__(self, folder, frames: int, id_file: str = "run_id"):
        super().__init__(folder, frames)
        self._id_file = Path(folder).absolute() / id_file
        self._run_id = self._id_file.read_text() if frames and self._id_file.is_file() else None

    def log(self, metrics: dict[str, float], frames: int) -> None:
        super().log(metrics, frames)
        self._send(metrics, frames)

    def close(self) -> None:
        super().close()
        self._end_run()


class TensorboardLogger(BackendLogger):
    """TensorBoard event files in the run folder; needs the extra ``pickplace[tensorboard]``. Args as `CsvLogger`."""

    def __init__(self, folder, frames: int = 0, settings: dict | None = None):
        with require_extra("logger", "tensorboard"):
            from torch.utils.tensorboard import SummaryWriter
        super().__init__(folder, frames)
        # purge_step: TensorBoard hides the events that came after the checkpoint of a resumed run.
        events = SummaryWriter(str(folder), purge_step=frames + 1 if frames else None)

        def send(metrics: dict[str, float], frames: int) -> None:
            for key, value in metrics.items():
                events.add_scalar(key, value, frames)

        self._send, self._end_run = send, events.close


class WandbLogger(BackendLogger):
    """Weights & Biases, through TorchRL's logger; needs the extra ``pickplace[wandb]``.

    Args:
        folder, frames, settings: as in `CsvLogger`.
        project: the project of the run.
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
        with require_extra("logger", "wandb"):
            import wandb  # noqa: F401
        from torchrl.record.loggers.wandb import WandbLogger as Backend

        super().__init__(folder, frames, "wandb_run_id")
        backend = Backend(
            Path(folder).name,
            offline=offline,
            save_dir=str(folder),
            id=self._run_id,
            project=project,
            log_env_packages=False,  # they hold paths of this machine; checkpoints hold the versions
            settings={"silent": offline, "console": "off"},
        )
        self._id_file.write_text(backend.experiment.id)
        self._send, self._end_run = backend.log_metrics, backend.experiment.finish
        if settings:
            backend.log_hparams(settings)


class MlflowLogger(BackendLogger):
    """MLflow, through TorchRL's logger; needs the extra ``pickplace[mlflow]``.

    Args:
        folder, frames, settings: as in `CsvLogger`.
        experiment: the experiment of the run.
        uri: database or server; None: ``mlflow.db`` in the run folder.
    """

    def __init__(
        self,
        folder,
        frames: int = 0,
        settings: dict | None = None,
        experiment: str = "pickplace",
        uri: str | None = None,
    ):
        with require_extra("logger", "mlflow"):
            import mlflow
        from torchrl.record.loggers.mlflow import MLFlowLogger as Backend

        super().__init__(folder, frames, "mlflow_run_id")
        folder = Path(folder).absolute()
        local = {} if uri else {"artifact_location": (folder / "mlflow_artifacts").as_uri()}
        before = os.environ.pop("MLFLOW_RUN_ID", None)
        if self._run_id:
            os.environ["MLFLOW_RUN_ID"] = self._run_id  # MLflow reads it; TorchRL's logger has no argument for it
        try:
            backend = Backend(experiment, uri or f"sqlite:///{folder / 'mlflow.db'}", **local)
        finally:
            os.environ.pop("MLFLOW_RUN_ID", None)
            if before is not None:
                os.environ["MLFLOW_RUN_ID"] = before
        self._id_file.write_text(backend.experiment.info.run_id)
        self._send, self._end_run = backend.log_metrics, mlflow.end_run
        if not self._run_id:
            mlflow.set_tag("mlflow.runName", folder.name)
            if settings:  # in a new run only: MLflow refuses changed values, which a resumed run may have
                backend.log_hparams(settings)


class NoLogger:
    """A logger that keeps nothing. Args as `CsvLogger`."""

    def __init__(self, folder=None, frames: int = 0, settings: dict | None = None):
        pass

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing: no file is open."""


def read_csv(path) -> list[dict[str, float]]:
    """Return the complete rows of a ``metrics.csv`` as numbers; see :func:`read_rows` for errors."""
    numbers = ({key: float(value) for key, value in row.items()} for row in read_rows(path))
    return [row | {"frames": int(row["frames"])} for row in numbers]


def read_rows(path, text: str | None = None) -> list[dict[str, str]]:
    """Return the complete rows of a ``metrics.csv`` as text, such as 4 or 4.0; empty cells are left out.

    Args:
        path: the file.
        text: its content, if it was read before; None: it is read now.

    Raises:
        ValueError: naming file and line, for a cell that is no number.
    """
    text = read_text(path) if text is None else text
    lines = text[: text.rfind("\n") + 1].splitlines()  # a killed run may leave an incomplete last line
    rows, table = [], csv.DictReader(lines or [text])
    refuse_if(
        "frames" not in (columns := table.fieldnames or ["frames"]),
        f"{path}, line 1: expected a column frames, got {excerpt(','.join(columns))}.",
    )
    for number, row in enumerate(table, start=2):
        try:
            cells = {key: value for key, value in row.items() if value}
            int({key: float(value) for key, value in cells.items()}["frames"])  # refuses inf, too
            rows.append(cells)
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise ValueError(f"{path}, line {number}: expected a number in each column ({error}).") from error
    return rows
