"""YAML with places: every value knows its file, line and column, and a duplicate key is an error.

The one reader of YAML in the program (configuration, plants, effects, profiles, models). PyYAML's safe constructors only.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 4_000_000  # a larger file is not one a person wrote
MAX_DEPTH = 60


class InputError(Exception):
    """Input that a person can mend. The message is one line: where, what, what was expected, what to do."""


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-9 as a number (YAML 1.2) and takes no dates, no yes/no and no octal numbers."""


_Loader.yaml_implicit_resolvers = {}
_NUMBER = r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
for _tag, _regex, _first in (
    ("tag:yaml.org,2002:bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("tag:yaml.org,2002:null", r"~|null|Null|NULL|", "~nN"),
    ("tag:yaml.org,2002:int", r"[-+]?[0-9][0-9_]*", "-+0123456789"),
    ("tag:yaml.org,2002:float", _NUMBER + r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+0123456789."),
):
    _Loader.add_implicit_resolver(
        _tag, re.compile(f"^(?:{_regex})$"), [*_first, *([""] if _tag.endswith("null") else [])]
    )


@dataclass(frozen=True)
class Node:
    """A YAML value with its place. `value` is a dict of str to Node, a list of Node, or a scalar
    (str, int, float, bool, None); `line` and `column` count from 1."""

    value: Any
    file: str
    line: int
    column: int

    @property
    def place(self) -> str:
        """'file:line:column' for messages."""
        return f"{self.file}:{self.line}:{self.column}"

    def plain(self) -> Any:
        """The value without places: dicts, lists and scalars."""
        if isinstance(self.value, dict):
            return {k: v.plain() for k, v in self.value.items()}
        if isinstance(self.value, list):
            return [v.plain() for v in self.value]
        return self.value

    def error(self, message: str) -> InputError:
        """An InputError that begins with the place; to be raised by the caller."""
        return InputError(f"{self.place}: {message}".replace("\n", "\\n"))  # a name may hold anything


def suggest(name: str, allowed: Iterable[str]) -> str:
    """' (did you mean X?)' where an allowed name is close, else ''."""
    near = difflib.get_close_matches(str(name), list(allowed), n=1, cutoff=0.6)
    return f" (did you mean '{near[0]}'?)" if near else ""


def load(path: str | Path) -> Node:
    """Read one YAML document. Raises InputError for a missing file, a syntax error or a duplicate key."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: {size} bytes; a YAML file of at most {MAX_BYTES} was expected")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as e:
        raise InputError(f"{path}: not UTF-8 text (byte {e.start}); a YAML file was expected") from None
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror or e}") from None
    return loads(text, str(path))


def loads(text: str, file: str = "<text>") -> Node:
    """The same from a string; `file` names it in messages."""
    loader = None
    try:
        loader = _Loader(text)
        root = loader.get_single_node()
        if root is None:
            raise InputError(f"{file}:1:1: the file is empty; a mapping was expected")
        return _convert(root, loader, file, 0)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        where = f"{file}:{mark.line + 1}:{mark.column + 1}" if mark else file
        hint = "" if "\t" not in text else " (a tab is not allowed as indentation)"
        raise InputError(f"{where}: not valid YAML: {e.problem or e.context}{hint}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        raise InputError(f"{file}: not valid YAML: {str(e).splitlines()[0]}") from None
    finally:
        if loader is not None:
            loader.dispose()


def _convert(node: yaml.Node, loader: _Loader, file: str, depth: int) -> Node:
    line, column = node.start_mark.line + 1, node.start_mark.column + 1
    place = f"{file}:{line}:{column}"
    if depth > MAX_DEPTH:
        raise InputError(f"{place}: nested deeper than {MAX_DEPTH} levels")
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Node] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(f"{place}: a key must be a plain word")
            if key.value in out:
                raise InputError(
                    f"{file}:{key.start_mark.line + 1}:{key.start_mark.column + 1}: '{key.value}' stands "
                    f"twice (first at line {out[key.value].line}); keep one of them"
                )
            out[key.value] = _convert(value, loader, file, depth + 1)
        return Node(out, file, line, column)
    if isinstance(node, yaml.SequenceNode):
        return Node([_convert(v, loader, file, depth + 1) for v in node.value], file, line, column)
    if node.tag.startswith("tag:yaml.org,2002:") and node.tag.rsplit(":", 1)[1] in (
        "str",
        "int",
        "float",
        "bool",
        "null",
    ):
        kind = node.tag.rsplit(":", 1)[1]
        try:
            if kind == "int":
                return Node(int(node.value.replace("_", "")), file, line, column)
            return Node(loader.construct_object(node), file, line, column)
        except (ValueError, yaml.YAMLError):
            raise InputError(f"{place}: '{node.value}' cannot be read as {kind}") from None
    raise InputError(f"{place}: the tag {node.tag} is not allowed here")
