"""ROS's own arguments on the command line: remaps, a namespace and a name of the node, without a ROS installation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Annotated, Any, TypeAlias

import tyro

from rover_rl.checks import NAME
from rover_rl.registry import perhaps

GLOBAL = {"tf_topic", "tf_static_topic", "clock_topic", "diagnostics_topic"}
"""Topics whose defaults are those of all robots: a namespace does not move them."""
RosArguments: TypeAlias = Annotated[Mapping[str, str], tyro.conf.Fixed, tyro.conf.Suppress]
"""Names by those that they replace, ``__ns`` and ``__node``. A field of a command that is no option."""
_RULE = re.compile(f"(?:-r|--remap) (__ns|__node|/?{NAME}(?:/{NAME})*):=(/?{NAME}(?:/{NAME})*|/)")


def split_ros_arguments(args: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Returns the other arguments, and the rules after ``--ros-args``. Raises ``ValueError`` for what is no rule."""
    own, rules, words, is_own = list[str](), dict[str, str](), iter(args), True
    for word in words:
        if word == "--ros-args" or (word == "--" and not is_own):
            is_own = word == "--"
        elif is_own:
            own.append(word)
        elif match := _RULE.fullmatch(given := f"{word} {next(words, '')}"):
            rules.setdefault(match[1], match[2])
        else:
            such = "-r /scan:=/front/scan, -r __ns:=/robot1 or -r __node:=driver"
            raise ValueError(f"--ros-args takes {such}, and ends with -- or the line, got {given!r}")
    return own, rules


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
