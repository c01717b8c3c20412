from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from rover_rl.files import errors_name, write_json, written_whole
from tests.full_disk import largest_file


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    path.write_text("old")

    def fail() -> None:
        with written_whole(path) as temporary:
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_write_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    with largest_file(10), pytest.raises(OSError, match="too large") as failure:
        write_json(path, [*range(1000)])
    assert failure.value.filename == str(path)
    with pytest.raises(IsADirectoryError) as is_folder:
        write_json(tmp_path, [])
    assert is_folder.value.filename == str(tmp_path)
    # A file in the place of a folder is named as it is.
    path.touch()
    with pytest.raises(OSError, match=r"data\.json'$"):
        write_json(path / "more.json", [])
    assert [*tmp_path.iterdir()] == [path]


def test_other_errors_are_unchanged(tmp_path: Path) -> None:
    other = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "elsewhere")
    for error in (ConnectionError("no cluster"), other):
        with pytest.raises(OSError) as raised, errors_name(tmp_path):
            raise error
        assert raised.value is error
