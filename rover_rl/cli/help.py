"""``--help``: the options of a command in groups, the common ones first, at any width."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from rich.console import Console

from rover_rl.algos.config import ALGORITHMS, CollectionConfig, NetworkConfig, RunConfig
from rover_rl.cli.parsing import ARGUMENTS, OPTIONS, PROGRAM, SUBCOMMANDS, CommandHelp, Option, read_help
from rover_rl.envs.config import EnvConfig

COMMON = "Common options"
"""Title of the first group, which also has the options that no group names."""
_AS_IS: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
"""How Rich prints a text that is wrapped already."""
_FIXED_SPACE = "\N{NO-BREAK SPACE}"
_COLUMN = 26
"""Column in which the text of an option begins."""
_WIDEST = 120
"""Width of the help on wider terminals."""


def _names(*kinds: type) -> str:
    return " ".join(item.name.replace("_", "-") for kind in kinds for item in fields(kind))


_ENVIRONMENT = "env robot backend physics"
GROUPS: dict[str, dict[str, str]] = {
    "train": {
        COMMON: "world algo max-minutes total-steps seed name backend num-envs robot reward randomize "
        "config from resume",
        "Environment": _names(EnvConfig),
        "Network": _names(NetworkConfig),
        "Data collection": _names(CollectionConfig),
        "Algorithm": _names(*ALGORITHMS.values()),
        "Run": _names(RunConfig).replace("started-from", "from"),
    },
    "evaluate": {COMMON: "world count seed seconds backend workers out", "Environment": _ENVIRONMENT},
    "benchmark barn": {COMMON: "data worlds", "Environment": _ENVIRONMENT},
    "benchmark jaxnav": {COMMON: "data", "Environment": _ENVIRONMENT},
    "film": {
        COMMON: "out world view seconds seed rovers",
        "Picture": "width height fps speed rewards",
        "Environment": _ENVIRONMENT,
    },
    "worlds import": {
        COMMON: "out name spawn goal bounds",
        "Gazebo worlds and meshes": "missing model-paths visuals ground up scale obstacle-error",
        "Elevation models": "cell pixel height",
        "ROS maps": "unknown wall-height",
    },
    "robot": {
        COMMON: "world robot backend rate seed env physics",
        "Lidar": "lidar-beams lidar-view",
        "ROS 2 topics": "scan-topic imu-topic cmd-vel-topic odometry-topic pose-topic reset-topic",
    },
    "drive": {
        COMMON: "goal goals random world seconds dry-run log seed",
        "Safety": "clearance wait max-speed max-yaw-rate max-acceleration max-yaw-acceleration",
        "What the policy was made for": "env robot allow-unseen allow-other-world",
        "ROS 2": "pose pose-topic odometry-topic scan-topic imu-topic cmd-vel-topic stamped lidar-yaw transport",
    },
}
"""Options of the groups in the help of each command, by title. The first group that names an option has it."""
GROUPS["sweep"] = GROUPS["train"] | {COMMON: f"vary trials episodes {GROUPS['train'][COMMON]}"}


def print_help(commands: dict[str, Any], name: str, console: Console) -> None:
    """Prints the help of a command.

    Args:
        commands: dataclasses of the commands by name, or instances that hold defaults.
        name: name of the command, of a subcommand such as ``"worlds import"``, or empty for the program.
        console: console to print to, whose width the help has.
    """
    found = read_help(commands, name)
    width = min(console.width, _WIDEST)
    console.print(_wrapped(f"Usage: {usage(found)}", width), **_AS_IS)
    for paragraph in found.description:
        console.print(f"\n{_wrapped(paragraph, width)}", **_AS_IS)
    for title, options in grouped(found).items():
        console.print(f"\n{title}", style="bold", **_AS_IS)
        for option in options:
            console.print("\n".join(_lines(option, width)), **_AS_IS)
    if SUBCOMMANDS in found.boxes:
        each = " ".join(filter(None, (PROGRAM, name, "COMMAND --help")))
        version = "" if name else f" {PROGRAM} --version prints the version."
        console.print(f"\n{_wrapped(f'{each} shows the options of a command.{version}', width)}", **_AS_IS)


def usage(found: CommandHelp) -> str:
    """Returns how a command is given, such as ``"rover-rl worlds import [OPTIONS] FILE"``."""
    required = [option.head for option in found.boxes.get(OPTIONS, ()) if option.text.endswith("(required)")]
    arguments = [
        option.head if option.text.endswith("(required)") else f"[{option.head}]"
        for option in found.boxes.get(ARGUMENTS, ())
    ]
    command = ""
    if SUBCOMMANDS in found.boxes:
        command = "[COMMAND]" if found.options else "COMMAND"
    return " ".join(filter(None, (PROGRAM, found.name, command, "[OPTIONS]", *required, *arguments)))


def grouped(found: CommandHelp) -> dict[str, list[Option]]:
    """Returns the arguments, options and subcommands of a command in the groups in which its help shows them."""
    named = GROUPS.get(found.name.split(" --")[0], {OPTIONS.capitalize(): ""})
    places: dict[str, str] = {}
    for title, words in named.items():
        for word in words.split():
            places.setdefault(f"--{word}", title)
    groups: dict[str, list[Option]] = {"Arguments": found.boxes.get(ARGUMENTS, []), **{title: [] for title in named}}
    # A subcommand without a text is what the command itself does.
    groups["Commands"] = [command for command in found.boxes.get(SUBCOMMANDS, ()) if command.text]
    for option in found.boxes.get(OPTIONS, ()):
        title = next((places[name] for name in option.names if name in places), next(iter(named)))
        groups[title].append(option)
    order = [*places]
    for title, options in groups.items():
        if title == COMMON:
            # In the order of the group; then the options that no group names.
            options.sort(key=lambda option: min(order.index(n) if n in places else len(order) for n in option.names))
    for title, options in found.boxes.items():
        if title not in (ARGUMENTS, OPTIONS, SUBCOMMANDS):
            groups[found.notes[title].rstrip(".") or title.capitalize()] = options
    return {title: options for title, options in groups.items() if options}


def _lines(option: Option, width: int) -> Iterator[str]:
    """Yields the lines of an option: how it is given, and beside or below it what it does."""
    head = f"  {option.head}"
    text = _wrapped(option.text, width - _COLUMN).splitlines() or [""]
    if len(head) + 2 > _COLUMN:
        yield head
        head = ""
    for line in text:
        yield f"{head:{_COLUMN}}{line}".rstrip()
        head = ""


def _wrapped(text: str, width: int) -> str:
    # A short default stays in one line.
    text = re.sub(r"\(default: .{1,30}\)$", lambda default: default[0].replace(" ", _FIXED_SPACE), text)
    lines = textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)
    return lines.replace(_FIXED_SPACE, " ")
