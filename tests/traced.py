"""Files of the package that run in a call."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any

import rover_rl

PACKAGE = str(Path(rover_rl.__file__).parent) + "/"


def files_that(call: Callable[[], Any], handle: Callable[[Iterable[Any]], bool] = lambda values: True) -> set[str]:
    """Files with functions that run in a call, and handle something among their variables, relative to the package."""
    found: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        file = frame.f_code.co_filename
        ours = event in ("call", "return") and file.startswith(PACKAGE) and file not in found
        if ours and handle(list(frame.f_locals.values())):
            found.add(file)

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return {file.removeprefix(PACKAGE) for file in found}
