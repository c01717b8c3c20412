"""Arrays that are kept on disk."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from rover_rl.worlds import cache
from rover_rl.worlds.cache import FOLDERS, code_key, content_key, load_arrays, store_arrays

kept = st.sampled_from([np.bool_, np.uint8, np.int64, np.float32]).flatmap(
    lambda kind: arrays(
        kind,
        array_shapes(min_dims=0, min_side=0, max_side=9),
        elements={"allow_nan": False} if kind is np.float32 else None,
    )
)


@settings(deadline=None)
@given(st.dictionaries(st.text(max_size=5), kept, max_size=4))
def test_arrays_are_loaded_as_they_were_stored(stored: dict[str, np.ndarray]) -> None:
    store_arrays("test", content_key("a key"), stored)
    loaded = load_arrays("test", content_key("a key"))
    assert loaded is not None
    assert list(loaded) == list(stored)
    for name, array in stored.items():
        assert (loaded[name].dtype, loaded[name].shape) == (array.dtype, array.shape)
        assert np.array_equal(loaded[name], array)
        loaded[name][...] = 0  # PyTorch warns of arrays that cannot be written.


def test_the_oldest_files_of_a_folder_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    noise = np.random.default_rng(0).integers(0, 256, 9000, dtype=np.uint8)
    monkeypatch.setattr(cache, "KEPT_BYTES", FOLDERS * 3500)
    for age, name in enumerate(("aa1", "aa2", "aa3", "bb1")):
        store_arrays("test", name, {"noise": noise[:1000]})
        (file,) = tmp_path.rglob(f"{name}.bin")
        # "aa3" is the oldest one.
        os.utime(file, (1e9 - age, 1e9 - age))
    store_arrays("test", "aa4", {"noise": noise[:1000]})
    left = sorted(path.stem for path in tmp_path.rglob("*.bin"))
    assert left == ["aa1", "aa2", "aa4", "bb1"]
    store_arrays("test", "aa5", {"noise": noise})
    assert sorted(path.stem for path in tmp_path.rglob("*.bin")) == ["aa5", "bb1"]
    assert load_arrays("test", "aa5") is not None


def test_another_version_of_the_code_has_another_key(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("1")
    before = code_key(tmp_path)
    (tmp_path / "a.py").write_text("2")
    code_key.cache_clear()
    assert code_key(tmp_path) != before
