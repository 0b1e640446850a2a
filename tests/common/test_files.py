"""Files are replaced as a whole."""

import os
from pathlib import Path

import pytest

from pickplace.common.files import read_table, replaced_file, sync_folder


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match="Not a directory") as caught, replaced_file(tmp_path / "file" / "x.csv") as new:
        new.write_text("1")
    assert caught.value.filename == str(tmp_path / "file" / "x.csv")
    assert (tmp_path / "file").read_text() == "no folder" and len([*tmp_path.iterdir()]) == 1


def test_a_block_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("old")
    with pytest.raises(ValueError, match="half"), replaced_file(path) as new:
        new.write_text("half")
        raise ValueError("half")
    assert path.read_text() == "old" and [*tmp_path.iterdir()] == [path]


def test_a_new_file_and_its_name_reach_the_disk(tmp_path, monkeypatch):
    """A rename without its folder may be undone by a power failure. The order: content, rename, folder."""
    synced = []

    def fsync(descriptor):
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        synced.append((path.name, (tmp_path / "x.csv").exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    with replaced_file(tmp_path / "x.csv") as new:
        new.write_text("1")
    assert synced == [(".x.new.csv", False), (tmp_path.name, True)]


def test_a_quote_that_is_never_closed_is_named_with_its_line(tmp_path):
    (path := tmp_path / "x.csv").write_text('w,d,h\n"1",1,1\n1,1,"2\n1,1,1\n')
    with pytest.raises(ValueError, match="x.csv, line 3: unexpected end of data; expected a CSV in UTF-8"):
        read_table("items.path", path, "w,d,h")


def test_a_folder_that_cannot_be_synced_is_left_alone(tmp_path):
    sync_folder(tmp_path / "nowhere")
