"""ROS's own arguments on the command line: remaps, parameters, a namespace and a name of the node.

They need no ROS installation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Annotated, Any, TypeAlias

import tyro
import yaml

from rover_rl.checks import NAME
from rover_rl.registry import perhaps

GLOBAL = {"tf_topic", "tf_static_topic", "clock_topic", "diagnostics_topic"}
"""Topics whose defaults are those of all robots: a namespace does not move them."""
RosArguments: TypeAlias = Annotated[Mapping[str, str], tyro.conf.Fixed, tyro.conf.Suppress]
"""Names by those that they replace, ``__ns`` and ``__node``. A field of a command that is no option."""
_RULE = re.compile(f"(?:-r|--remap) (__ns|__node|/?{NAME}(?:/{NAME})*):=(/?{NAME}(?:/{NAME})*|/)")
_PARAMETER = re.compile(rf"(?:-p|--param) ({NAME}(?:\.{NAME})*):=(.+)", re.DOTALL)


def split_ros_arguments(args: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Returns the other arguments, and the rules after ``--ros-args``. Raises ``ValueError`` for what is no rule.

    Parameters become options at the end of the other arguments, those of files first.
    """
    own, rules, words, is_own = list[str](), dict[str, str](), iter(args), True
    given_parameters, files = dict[str, Any](), list[str]()
    for word in words:
        if word == "--ros-args" or (word == "--" and not is_own):
            is_own = word == "--"
        elif is_own:
            own.append(word)
        elif word == "--params-file":
            files.append(next(words, ""))
        elif match := _RULE.fullmatch(given := f"{word} {next(words, '')}"):
            rules.setdefault(match[1], match[2])
        elif match := _PARAMETER.fullmatch(given):
            given_parameters[match[1]] = _value(match[2], given)
        else:
            such = "-r /scan:=/front/scan, -r __ns:=/robot1, -r __node:=driver, -p pose:=tf or --params-file FILE"
            raise ValueError(f"--ros-args takes {such}, and ends with -- or the line, got {given!r}")
    parameters: dict[str, Any] = {}
    for file in files:
        parameters |= _parameters_of(file, rules.get("__node"))
    return [*own, *_options(parameters | given_parameters)], rules


def _parameters_of(file: str, node: str | None) -> dict[str, Any]:
    """Returns the parameters in a file of ROS for a node, and for all nodes: ``/**: {ros__parameters: {pose: tf}}``."""
    # Imports PyTorch.
    from rover_rl.algos.config_files import read_yaml
    from rover_rl.sims.ros2.settings import Ros2Settings

    found, data = dict[str, Any](), read_yaml(file)
    for name, entry in data.items() if isinstance(data, dict) else ():
        parameters = entry.get("ros__parameters") if isinstance(entry, dict) else None
        if not isinstance(parameters, dict):
            raise ValueError(f"{file} must have ros__parameters under the name of a node or /**, and {name} has none")
        if str(name).rpartition("/")[2] in ("**", node or Ros2Settings.node):
            found |= parameters
    return found


def _options(parameters: Mapping[str, Any], part: str = "") -> list[str]:
    """Returns parameters as options: ``give_way: true`` is ``--give-way``. The clock is followed in any case."""
    words = list[str]()
    for name, value in parameters.items():
        head, _, rest = name.replace("_", "-").partition(".")
        if rest or isinstance(value, Mapping):
            words += _options({rest: value} if rest else value, f"{part}{head}.")
        elif name != "use_sim_time":
            values = [] if isinstance(value, bool) else value if isinstance(value, list) else [value]
            words += [f"--{part}{'no-' if value is False else ''}{head}", *map(str, values)]
    return words


def _value(text: str, given: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"a parameter is a value of YAML, such as -p max_speed:=0.5, got {given!r}") from error


def renamed(rules: Mapping[str, str], *parts: Any) -> list[Any]:
    """Returns dataclasses with new topics, which are fields that end in ``_topic``, and names of their ``node``.

    A namespace stands before the default topics, but for :data:`GLOBAL`, and before topics that do not begin with
    ``/``. A rule names a topic with its namespace or without. Raises ``ValueError`` if a rule names none of them.
    """
    known, changed, unused = list[str](), list[Any](), {*rules} - {"__ns", "__node"}
    for part in parts:
        changes = {"node": node_name(rules, part.node)} if hasattr(part, "node") else {}
        for field in fields(part):
            if field.name.endswith("_topic") and (topic := getattr(part, field.name)) is not None:
                moves = topic == field.default and field.name not in GLOBAL
                full = _full(rules, topic.strip("/") if moves else topic)
                fits = [old for old in rules if topic == old or full == _full(rules, old)]
                changes[field.name] = _full(rules, rules[fits[0]]) if fits else full
                unused -= {*fits}
                known.append(topic)
        changed.append(replace(part, **changes))
    for old in sorted(unused):
        text = f"no topic is called {old}{perhaps(old, known)}; use one of {known}"
        raise ValueError(f"-r {old}:={rules[old]}: {text}")
    return changed


def node_name(rules: Mapping[str, str], usual: str) -> str:
    """Returns the name of a node that is usually called otherwise, after its namespace, if it has one."""
    name = rules.get("__node", usual)
    return _full(rules, name) if "__ns" in rules else name


def _full(rules: Mapping[str, str], name: str) -> str:
    return name if name.startswith("/") else re.sub("/+", "/", f"/{rules.get('__ns', '')}/{name}")
