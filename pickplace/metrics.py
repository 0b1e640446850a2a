"""Where metrics go (config group ``logger``). Names: ``train/...``, ``eval/...``, ``curriculum/...``, ``time/...``."""

import csv
from contextlib import suppress
from pathlib import Path


class CsvLogger:
    """One table, ``metrics.csv``, a row for each batch and a column for each metric; the first column is ``frames``.

    A new metric adds a column. After a resume the table goes on where the checkpoint left off: rows beyond it, which a
    killed run may have left, are dropped.

    Args:
        folder: the run folder.
        frames: frames already trained; 0 for a new run.
    """

    def __init__(self, folder, frames: int = 0):
        self.path = Path(folder) / "metrics.csv"
        self._columns, self._file = ["frames"], None
        earlier = read_csv(self.path) if frames and self.path.is_file() else []
        self._rewrite([row for row in earlier if row["frames"] <= frames])

    def _rewrite(self, rows):
        """Begin the file anew, with columns for all that these rows hold."""
        self.close()
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
                self._rewrite([*read_csv(self.path), row])
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Close the file; what a full disk did not take is lost."""
        if self._file:
            with suppress(OSError):
                self._file.close()


class TensorboardLogger:
    """TensorBoard event files in the run folder; needs the extra ``pickplace[tensorboard]``. Args as `CsvLogger`."""

    def __init__(self, folder, frames: int = 0):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ValueError(
                "logger=tensorboard: tensorboard is missing; pip install 'pickplace[tensorboard]'."
            ) from error
        # Events after the checkpoint that a run is resumed from are hidden by TensorBoard itself.
        self._writer = SummaryWriter(str(folder), purge_step=frames + 1 if frames else None)

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Add a point to each metric's curve."""
        for key, value in metrics.items():
            self._writer.add_scalar(key, value, frames)

    def close(self) -> None:
        """Flush and close the event file."""
        self._writer.close()


class NoLogger:
    """Keeps nothing. Args as `CsvLogger`."""

    def __init__(self, folder=None, frames: int = 0):
        pass

    def log(self, metrics: dict[str, float], frames: int) -> None:
        """Forget the metrics."""

    def close(self) -> None:
        """Nothing to close."""


def read_csv(path) -> list[dict[str, float]]:
    """The complete rows of a ``metrics.csv``; a metric that a row lacks is left out."""
    with Path(path).open(newline="") as file:
        text = file.read()
    lines = text[: text.rfind("\n") + 1].splitlines()  # a killed run may have cut the last line short
    rows = []
    for row in csv.DictReader(lines):
        rows.append({key: float(value) for key, value in row.items() if value})
        rows[-1]["frames"] = int(rows[-1]["frames"])
    return rows
