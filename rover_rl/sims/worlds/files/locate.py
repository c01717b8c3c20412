"""Search for the files that a world file names, within the folders that it may read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

MODEL_PATH_VARIABLES = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")
"""Environment variables with folders of models, as Gazebo reads them."""


class OutsideError(ValueError):
    """A world file names a file on the network, or outside of the folders that it may read."""


class Locator:
    """Finds the files that a world file names.

    A file may only be in the folder of the world file, in its sibling folder ``models``, or in a folder of models. A
    symbolic link in such a folder is followed: ROS workspaces install models as links.

    Args:
        file: the world file.
        model_paths: folders of models.
    """

    def __init__(self, file: Path, model_paths: Sequence[str] = ()) -> None:
        folder = Path(os.path.abspath(file)).parent
        given = [Path(path) for path in model_paths]
        for variable in MODEL_PATH_VARIABLES:
            given += [Path(path) for path in os.environ.get(variable, "").split(os.pathsep) if path]
        beside = [folder, folder / "models", folder.parent / "models"]
        self._searched = [*(Path(os.path.abspath(path)) for path in given), *beside]
        # The world file may itself be in a folder of models, whose other models it uses.
        self._allowed = [*self._searched, *([folder.parent] if (folder / "model.config").is_file() else [])]

    def find(self, uri: str, folder: Path) -> Path | None:
        """Returns the file or folder that a URI names.

        Args:
            uri: ``model://NAME/path``, ``package://NAME/path``, ``file://path``, or a path relative to ``folder``.
            folder: folder of the file that holds the URI.

        Returns:
            The path. ``None`` if there is no such file.

        Raises:
            OutsideError: if the URI is on the network or outside of the folders that may be read.
        """
        uri = unquote(uri.strip())
        scheme, _, rest = uri.rpartition("://")
        if scheme not in ("", "file", "model", "package") or "\0" in uri:
            raise OutsideError(f"{uri} is not a local file")
        if scheme in ("model", "package"):
            leaves = os.path.isabs(rest) or os.path.normpath(rest).startswith("..")
            # A model may also name its neighbors in the folder that it was found in.
            folders = [
                *self._searched,
                *(path.parent for path in (folder, *folder.parents) if self._allows(path.parent)),
            ]
        else:
            leaves = not self._allows(_joined(folder, rest))
            folders = [folder, *self._searched]
        if leaves:
            raise OutsideError(f"{uri} leaves the folder of the world")
        found = (_joined(place, rest) for place in folders if rest)
        return next((path for path in found if self._allows(path) and path.exists()), None)

    def _allows(self, path: Path) -> bool:
        return any(path.is_relative_to(folder) for folder in self._allowed)


def _joined(folder: Path, name: str) -> Path:
    return Path(os.path.abspath(folder / name))
