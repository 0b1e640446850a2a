"""Reading of files that a user or a run folder of unknown origin names, and replacement of files as a whole."""

import csv
import io
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pickplace.common.validate import excerpt, refuse_above, refuse_if, reword_errors

#: Greatest size of a file that is read, in bytes, unless a reader sets its own: more would fill the memory.
MAX_BYTES = 2**30
#: Greatest size of a table of settings: its rows take more memory than the file.
MAX_TABLE_BYTES = 100_000_000


def read_file(path, most: int = MAX_BYTES, links: bool = True, empty: bool = True) -> bytes:
    """Return the content of a regular file. Pipes and devices are not opened: reading them could block or never end.

    The size is that at the beginning, which is 0 for the endless files of ``/proc``.

    Args:
        path: the file.
        most: greatest size, in bytes.
        links: follow a symbolic link instead of refusing it.
        empty: accept a file of 0 bytes instead of refusing it.

    Raises:
        ValueError: naming the file, if it is too large or not a regular one.
        OSError: if there is none, or it cannot be read.
    """
    path = Path(path)
    found = path.stat(follow_symlinks=links)
    refuse_if(not stat.S_ISREG(found.st_mode), f"{path}: a folder, link, pipe or device; expected a regular file.")
    refuse_above(f"{path}:", found.st_size, "bytes", most)
    refuse_if(not (found.st_size or empty), f"{path}: 0 bytes; expected a file with content.")
    with path.open("rb") as file:
        return file.read(found.st_size)


def read_text(path, most: int = MAX_BYTES, encoding: str = "utf-8", empty: bool = True) -> str:
    """Return the text of a regular file; for arguments and errors see :func:`read_file`."""
    with reword_errors(
        UnicodeDecodeError, lambda error: ValueError(f"{path}, {_bad_byte(error)}; expected a text in UTF-8.")
    ):
        return read_file(path, most, empty=empty).decode(encoding)


def _bad_byte(error: UnicodeDecodeError) -> str:
    """Return the line and the value of a byte that is not UTF-8."""
    line = error.object[: error.start].count(b"\n") + 1
    return f"line {line}: got the byte 0x{error.object[error.start]:02x}"


def csv_rows(path, text: str, separator: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a CSV text: the number of the line where the row begins, and its fields without white space.

    Args:
        path: the file, for messages.
        text: its content.
        separator: of the fields.

    Raises:
        ValueError: naming the file and the line, for example for a quote that is never closed.
    """
    reader, line = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True), 1

    def refusal(error: csv.Error) -> ValueError:
        return ValueError(f"{path}, line {line}: {error}; expected a CSV in UTF-8, each quote closed in its field.")

    with reword_errors(csv.Error, refusal):
        for row in reader:
            yield line, [field.strip() for field in row]
            line = reader.line_num + 1


def read_table(key: str, path, *headers: str) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the header of a CSV file, and for each other row its line number and its fields, without white space.

    Args:
        key: the setting that names the file.
        path: the file.
        headers: the headers that it may have, with commas.

    Raises:
        ValueError: naming the file, if it does not exist, has another header, or has no row below it.
    """
    refuse_if(
        not Path(path).exists(),
        f"{key}={str(path)!r}: no such file; expected a CSV with columns {' or '.join(headers)}.",
    )
    table = [*csv_rows(path, read_text(path, MAX_TABLE_BYTES, "utf-8-sig", empty=False))]
    header = ",".join(table[0][1]) if table else ""
    rows = [(line, fields) for line, fields in table[1:] if any(fields)]
    refuse_if(
        header not in headers, f"{path}: the header is {excerpt(header)}, expected {' or '.join(map(repr, headers))}."
    )
    refuse_if(not rows, f"{path}: no rows, expected at least one below the header.")
    return header, rows


@contextmanager
def replaced_file(path):
    """Yield the path of a new file beside ``path``, which replaces it when the block ends.

    If the block fails, the old file stays as it was and nothing of the new one is left. An old file that is a link is
    replaced; its target is not written. When the function returns, the disk has the new file under its name: a power
    failure after that does not bring the old one back.

    Raises:
        OSError: naming ``path``, if it cannot be written, for example because the disk is full.
    """
    path = Path(path)
    new = _beside(path)
    with _naming(path):
        try:
            new.unlink(missing_ok=True)  # it may be a link
            yield new
            _put_in_place(new, path)
            sync_folder(path.parent)
        finally:
            new.unlink(missing_ok=True)


def replace_files(folder: Path, texts: Iterable[tuple[str, str]]) -> None:
    """Write files, given by name and text, as :func:`replaced_file` does. The old ones stay until all are written."""
    written: list[tuple[Path, Path]] = []
    try:
        for name, text in texts:
            new = _beside(path := folder / name)
            written.append((new, path))
            with _naming(path):
                new.unlink(missing_ok=True)
                new.write_text(text, encoding="utf-8")
        for new, path in written:
            with _naming(path):
                _put_in_place(new, path)
        sync_folder(folder)
    finally:
        for new, _ in written:
            new.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.stem}.new{path.suffix}")


def _naming(path: Path):
    """Return a context in which an ``OSError`` names the path."""
    return reword_errors(OSError, lambda error: OSError(error.errno, error.strerror or str(error), str(path)))


def _put_in_place(new: Path, path: Path) -> None:
    with new.open("rb") as file:
        os.fsync(file.fileno())
    new.replace(path)


def sync_folder(folder) -> None:
    """Write the names in a folder to the disk: only then does a rename survive a power failure.

    Nothing is done on file systems that cannot do it for a folder, such as some in a network.
    """
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
