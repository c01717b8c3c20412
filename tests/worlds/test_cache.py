"""Arrays that are kept on disk."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rover_rl.worlds import cache
from rover_rl.worlds.cache import FOLDERS, code_key, load_arrays, store_arrays


def test_arrays_are_loaded_as_they_were_stored(own_cache: Path) -> None:
    stored = {"cells": np.eye(9, dtype=bool), "one": np.array(3), "none": np.zeros((0, 2), np.float32)}
    assert load_arrays("test", "aa") is None
    store_arrays("test", "aa", stored)
    loaded = load_arrays("test", "aa")
    assert loaded is not None
    for name, array in loaded.items():
        assert (array.dtype, array.tolist()) == (stored[name].dtype, stored[name].tolist())


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: data[:60] + b"?" + data[61:]])
def test_a_damaged_file_is_as_none(damage, own_cache: Path) -> None:
    store_arrays("test", "aa", {"noise": np.random.default_rng(0).random(99)})
    (file,) = own_cache.rglob("aa.npz")
    file.write_bytes(damage(file.read_bytes()))
    assert load_arrays("test", "aa") is None


def test_the_oldest_files_of_a_folder_are_deleted(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, 9000, dtype=np.uint8)
    for age, name in enumerate(("aa1", "aa2", "aa3", "bb1")):
        store_arrays("test", name, {"noise": noise[:1000]})
        (file,) = own_cache.rglob(f"{name}.npz")
        # "aa3" is the oldest one.
        os.utime(file, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(cache, "KEPT_BYTES", FOLDERS * 3.5 * file.stat().st_size)
    store_arrays("test", "aa4", {"noise": noise[:1000]})
    assert sorted(path.stem for path in own_cache.rglob("*.npz")) == ["aa1", "aa2", "aa4", "bb1"]
    store_arrays("test", "aa5", {"noise": noise})
    assert sorted(path.stem for path in own_cache.rglob("*.npz")) == ["aa5", "bb1"]
    assert load_arrays("test", "aa5") is not None


def test_another_version_of_the_code_has_another_key(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("1")
    before = code_key(tmp_path)
    (tmp_path / "a.py").write_text("2")
    code_key.cache_clear()
    assert code_key(tmp_path) != before
