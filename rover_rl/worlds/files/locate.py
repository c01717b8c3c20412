"""Search for the files that a world file names, within the folders that it may read."""

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
"""Largest number of files and folders among which a name is searched."""


class OutsideError(ValueError):
    """A world file names a file on the network, or outside of the folders that it may read."""


class Locator:
    """Finds the files that a world file names.

    A file may only be in the folder of the world file, in its sibling folder ``models``, or in a folder of models. A
    symbolic link in such a folder is followed: ROS workspaces install models as links.

    Attributes:
        elsewhere: what was found by its name alone, one sentence each.
        missing: what :meth:`file` did not find, and why.
    """

    def __init__(self, file: Path, model_paths: Sequence[str] = ()) -> None:
        self.elsewhere: list[str] = []
        self.missing: list[str] = []
        folder = Path(os.path.abspath(file)).parent
        variables = (os.environ.get(variable, "").split(os.pathsep) for variable in MODEL_PATH_VARIABLES)
        given = [*model_paths, *(path for paths in variables for path in paths if path)]
        beside = [folder, folder / "models", folder.parent / "models"]
        self._searched = [*(Path(os.path.abspath(path)) for path in given), *beside]
        # The world file may itself be in a folder of models, whose other models it uses.
        self._allowed = [*self._searched, *([folder.parent] if (folder / "model.config").is_file() else [])]

    def find(self, uri: str, folder: Path) -> Path | None:
        """Returns the file or folder that a URI names in a file of ``folder``. ``None`` if there is no such file.

        URIs are ``model://NAME/path``, ``package://NAME/path``, ``file://path``, or relative paths. What is not where
        the URI says, such as a file of another machine, is searched by its name in the folder of the world and the
        folders of models, and what is in them.

        Raises:
            OutsideError: if the URI is on the network, or outside of the folders that may be read and not found by its
                name either.
        """
        uri = unquote(uri.strip())
        scheme, _, rest = uri.rpartition("://")
        if scheme in ("http", "https"):
            # A model of Fuel that was downloaded: .../models/NAME, NAME/VERSION or NAME/VERSION/files/FILE.
            wanted = re.sub(r"(/models/[^/]+)(/tip|/\d+)?/*$", r"\1", rest)
            found = self._by_name(uri, PurePosixPath(wanted))
            if found is not None:
                return found
        if scheme not in ("", "file", "model", "package") or "\0" in uri:
            raise OutsideError(f"{uri} is not a local file")
        if scheme in ("model", "package"):
            leaves = os.path.isabs(rest) or os.path.normpath(rest).startswith("..")
            # A model may also name its neighbors in the folder that it was found in.
            neighbors = [path.parent for path in (folder, *folder.parents) if self._allows(path.parent)]
            folders = [*self._searched, *neighbors]
        else:
            leaves = not self._allows(_joined(folder, rest))
            folders = [folder, *self._searched]
        places = () if leaves else (_joined(place, rest) for place in folders if rest)
        found = next((path for path in places if self._allows(path) and path.exists()), None)
        if found is None:
            found = self._by_name(uri, PurePosixPath(rest.replace("\\", "/")))
        if found is None and leaves:
            raise OutsideError(f"{uri} leaves the folder of the world, and no file of its name is in it")
        return found

    def file(self, uri: str, folder: Path, of_folder: Callable[[Path], Path | None] = Path) -> Path | None:
        """Returns the file that a URI names, or ``of_folder`` of the folder that it names. Records what is missing."""
        try:
            path = self.find(uri, folder)
        except OutsideError as error:
            self.missing.append(str(error))
            return None
        if path is not None and path.is_dir():
            path = of_folder(path)
        if path is None or not path.is_file():
            self.missing.append(f"{uri} is not found")
            return None
        return path

    def _by_name(self, uri: str, wanted: PurePosixPath) -> Path | None:
        """Returns the file or model of the same name whose path ends most like the one that is wanted."""
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
        """Files, and folders of models, in the searched folders by name."""
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

    def _allows(self, path: Path) -> bool:
        return any(path.is_relative_to(folder) for folder in self._allowed)


def _version(path: Path, uri: str) -> float:
    """Returns how good the version in the name of a folder is: the one that a URI names, else the newest."""
    if not path.name.isdecimal():
        return -1.0
    return math.inf if path.name in uri.split("/") else float(path.name)


def _joined(folder: Path, name: str) -> Path:
    return Path(os.path.abspath(folder / name))
