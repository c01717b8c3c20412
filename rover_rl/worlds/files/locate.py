"""Search for the files that a world file names."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import takewhile
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

MODEL_PATH_VARIABLES = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")
"""Environment variables with folders of models, as Gazebo reads them."""
MAX_SEARCHED = 50_000
"""Largest number of files and folders among which a name is searched, so that a world in a home folder is quick."""


class Locator:
    """Finds the files that a world file names.

    Attributes:
        elsewhere: what was found by its name alone, one sentence each.
        missing: what :meth:`file` did not find.
    """

    def __init__(self, file: Path, model_paths: Sequence[str] = ()) -> None:
        self.elsewhere: list[str] = []
        self.missing: list[str] = []
        folder = Path(os.path.abspath(file)).parent
        variables = (os.environ.get(variable, "").split(os.pathsep) for variable in MODEL_PATH_VARIABLES)
        given = [*model_paths, *(path for paths in variables for path in paths if path)]
        self._searched = [*(Path(os.path.abspath(path)) for path in given)]
        self._searched += [folder, folder / "models", folder.parent / "models"]

    def find(self, uri: str, folder: Path) -> Path | None:
        """Returns the file or folder that a URI names in a file of ``folder``. ``None`` if there is no such file.

        URIs are ``model://NAME/path``, ``package://NAME/path``, ``file://path``, or relative paths. What is not where
        the URI says, such as a file of another machine, is searched by its name in the folder of the world and the
        folders of models, and what is in them.
        """
        uri = unquote(uri.strip())
        scheme, _, rest = uri.rpartition("://")
        if scheme in ("http", "https"):
            # A model of Fuel that was downloaded: .../models/NAME, NAME/VERSION or NAME/VERSION/files/FILE.
            return self._by_name(uri, PurePosixPath(re.sub(r"(/models/[^/]+)(/tip|/\d+)?/*$", r"\1", rest)))
        # A model may also name its neighbors in the folder that it was found in.
        folders = [*self._searched, *folder.parents] if scheme in ("model", "package") else [folder, *self._searched]
        places = (Path(os.path.abspath(place / rest)) for place in folders if rest)
        found = next((path for path in places if path.exists()), None)
        return found or self._by_name(uri, PurePosixPath(rest.replace("\\", "/")))

    def file(self, uri: str, folder: Path, of_folder: Callable[[Path], Path | None] = Path) -> Path | None:
        """Returns the file that a URI names, or ``of_folder`` of the folder that it names. Records what is missing."""
        path = self.find(uri, folder)
        if path is not None and path.is_dir():
            path = of_folder(path)
        if path is None or not path.is_file():
            self.missing.append(f"{uri} is not found")
            return None
        return path

    def _by_name(self, uri: str, wanted: PurePosixPath) -> Path | None:
        ends = wanted.parts[::-1]

        def alike(path: Path) -> int:
            return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(path.parts[::-1], ends, strict=False)))

        # Gazebo stores models of Fuel by their names in lower case, in a folder for each version.
        names = (wanted.name, wanted.name.lower()) if wanted.name not in ("", "..") else ()
        candidates = next(filter(None, (self._names.get(name) for name in names)), ())
        found = max(candidates, key=lambda path: (alike(path), _version(path, uri)), default=None)
        if found is not None:
            self.elsewhere.append(f"{uri} is taken from {found}")
        return found

    @cached_property
    def _names(self) -> dict[str, list[Path]]:
        names: dict[str, list[Path]] = {}
        seen = 0
        for top in dict.fromkeys(self._searched):
            for place, folders, files in os.walk(top):
                folders[:] = sorted(name for name in folders if not name.startswith("."))
                seen += len(files) + len(folders)
                if seen > MAX_SEARCHED:
                    return names
                if {"model.config", "model.sdf"} & {*files}:
                    model = Path(place)
                    names.setdefault(model.parent.name if model.name.isdecimal() else model.name, []).append(model)
                for name in sorted(files):
                    names.setdefault(name, []).append(Path(place) / name)
        return names


def _version(path: Path, uri: str) -> float:
    if not path.name.isdecimal():
        return -1.0
    return math.inf if path.name in uri.split("/") else float(path.name)
