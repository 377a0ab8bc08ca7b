"""YAML with places: every value knows its file, line and column, and a duplicate key is an error.

`load` gives a `Node`. A `Section` reads a mapping key by key and refuses unknown keys. Only PyYAML's safe
constructors are used.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, overload

import yaml

MAX_BYTES = 4_000_000  # a larger file was not written by a person
MAX_DEPTH = 60
_UNSEEN = re.compile("[\t\u00a0\u2007\u200b\u202f\u2060\u3000]")
MAX_NUMBER = 1e300  # squares of larger numbers overflow


class InputError(Exception):
    """An error in the user's input. The message is one line: place, problem, expectation, remedy."""


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-9 as a number (YAML 1.2); no dates, no yes/no, no octal numbers."""


class _Fast(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The loader of libyaml, five times as fast. _Loader reads a file that it refuses, for its message."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes text which _Loader would read as a number, such as 0E0."""


_Loader.yaml_implicit_resolvers = {}
_Fast.yaml_implicit_resolvers = {}
_NUMBER = r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
for _tag, _regex, _first in (
    ("tag:yaml.org,2002:bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("tag:yaml.org,2002:null", r"~|null|Null|NULL|", "~nN"),
    ("tag:yaml.org,2002:int", r"[-+]?[0-9][0-9_]*", "-+0123456789"),
    ("tag:yaml.org,2002:float", _NUMBER + r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+0123456789."),
):
    for _class in (_Loader, _Fast, _Dumper):
        _class.add_implicit_resolver(
            _tag, re.compile(f"^(?:{_regex})$"), [*_first, *([""] if _tag.endswith("null") else [])]
        )


def dumps(data: Any) -> str:
    """Return plain data as YAML text that this module reads back equal."""
    return yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=150, default_flow_style=None
    )


@dataclass(frozen=True)
class Node:
    """A YAML value with its place.

    `value` is a dict of str to Node, a list of Node, or a scalar (str, int, float, bool, None); `line` and
    `column` count from 1."""

    value: Any
    file: str
    line: int
    column: int

    @property
    def place(self) -> str:
        """'file:line:column' for messages."""
        return f"{self.file}:{self.line}:{self.column}"

    def plain(self) -> Any:
        """Return the value as plain dicts, lists and scalars, without line numbers."""
        if isinstance(self.value, dict):
            return {k: v.plain() for k, v in self.value.items()}
        if isinstance(self.value, list):
            return [v.plain() for v in self.value]
        return self.value

    def error(self, message: str) -> InputError:
        """Return an InputError that begins with the place; to be raised by the caller."""
        return InputError(f"{self.place}: {message}".replace("\n", "\\n"))  # a name may contain line breaks


def suggest(name: str, allowed: Iterable[str]) -> str:
    """Return ' (did you mean X?)' if an allowed name is close to `name`, else ''."""
    found = near(name, allowed)
    return f" (did you mean '{found}'?)" if found else ""


def near(name: str, allowed: Iterable[str]) -> str | None:
    """Return the allowed name that is close to `name` in any case, if there is one."""
    folded = {str(a).casefold(): a for a in allowed}
    found = difflib.get_close_matches(str(name).casefold(), folded, n=1, cutoff=0.6)
    return folded[found[0]] if found else None


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
    """Read one YAML document from a string; `file` names it in messages."""
    loader: _Loader | _Fast | None = None
    try:
        try:
            loader = _Loader(text) if "\t" in text else _Fast(text)  # libyaml takes tabs that YAML does not
            root = loader.get_single_node()
        except (yaml.YAMLError, ValueError):
            loader = _Loader(text)
            root = loader.get_single_node()
        if root is None:
            raise InputError(f"{file}:1:1: the file is empty; a mapping was expected")
        return _convert(root, loader, file, 0)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        where = f"{file}:{mark.line + 1}:{mark.column + 1}" if mark else file
        raise InputError(f"{where}: not valid YAML: {e.problem or e.context}{_unseen(text)}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        raise InputError(f"{file}: not valid YAML: {str(e).splitlines()[0]}") from None
    finally:
        if loader is not None:
            loader.dispose()


def _unseen(text: str) -> str:
    """Name the first character of a broken file that looks like a blank and is none, with its line."""
    found = _UNSEEN.search(text)
    if found is None:
        return ""
    name = "tab is not allowed as indentation" if found[0] == "\t" else f"U+{ord(found[0]):04X} is no blank"
    return f" (a {name}: line {text.count(chr(10), 0, found.start()) + 1})"


def _convert(node: yaml.Node, loader: _Loader | _Fast, file: str, depth: int) -> Node:
    line, column = node.start_mark.line + 1, node.start_mark.column + 1
    place = f"{file}:{line}:{column}"
    if depth > MAX_DEPTH:
        raise InputError(f"{place}: nested deeper than {MAX_DEPTH} levels")
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Node] = {}
        _refuse_commas(node, file)
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
    standard, _, kind = node.tag.rpartition(":")
    if standard == "tag:yaml.org,2002" and kind in ("str", "int", "float", "bool", "null"):
        try:
            if kind == "int":
                return Node(_whole(node.value, place), file, line, column)
            return Node(loader.construct_object(node), file, line, column)
        except (ValueError, yaml.YAMLError):
            raise InputError(f"{place}: '{node.value}' cannot be read as {kind}") from None
    raise InputError(f"{place}: the tag {node.tag} is not allowed here")


def _whole(text: str, place: str) -> int:
    number = int(text.replace("_", ""))
    if abs(number) < MAX_NUMBER:
        return number
    raise InputError(f"{place}: the number is too large; one below {MAX_NUMBER:g} was expected")


def _refuse_commas(node: yaml.MappingNode, file: str) -> None:
    """Raise InputError where a comma ends a value in braces: `{value: 3,5}`, `{rate: min(a, b)}`.

    YAML takes what follows the comma for a key without a value."""
    for (_, before), (key, value) in pairwise(node.value):
        if value.value or not isinstance(before, yaml.ScalarNode):
            continue
        begin, end, said = key.start_mark, before.end_mark, ""
        if not before.style and before.value.count("(") > before.value.count(")"):
            said = f'a comma ends this value; quote the whole: "{before.value}, ..."'
        elif begin.line == end.line and begin.column == end.column + 1:
            said = decimal_comma(f"{before.value},{key.value}")
        if said:
            raise InputError(f"{file}:{before.start_mark.line + 1}:{before.start_mark.column + 1}: {said}")


def decimal_comma(text: str) -> str:
    """Return a sentence where a text is a number with a decimal comma, also with a unit; '' else."""
    if not re.fullmatch(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?(?: .*)?", text):
        return ""
    return f"'{text}' has a decimal comma; write {text.replace(',', '.')}"


class Section:
    """A YAML mapping read key by key; `end()` refuses the keys that were not read.

    `what` names the mapping in errors; `of`, if given, names the item that its keys belong to ("noise of
    'y'")."""

    def __init__(self, node: Node, what: str, of: str = "") -> None:
        if not isinstance(node.value, dict):
            raise node.error(f"{what}: a mapping (key: value) was expected, found {kind_of(node)}")
        self.node, self.what, self.of, self.asked = node, what, of, set[str]()

    def label(self, key: str) -> str:
        """Return the key as errors name it."""
        return f"{key} of '{self.of}'" if self.of else key

    @overload
    def get(self, key: str, required: Literal[True] = True) -> Node: ...
    @overload
    def get(self, key: str, required: bool) -> Node | None: ...

    def get(self, key: str, required: bool = True) -> Node | None:
        """Return the value's node, or None. Raises InputError where a required key is missing."""
        self.asked.add(key)
        found: Node | None = self.node.value.get(key)
        if found is None and required:
            # a key such as initial_sigma is no misspelt initial
            others = [k for k in self.node.value if k not in self.asked and not str(k).startswith(f"{key}_")]
            near = difflib.get_close_matches(key, others, n=1)
            hint = f"; is '{near[0]}' meant to be it?" if near else ""
            raise self.node.error(f"{self.what}: '{key}' is missing{hint}")
        return found

    def given(self, key: str) -> Node | None:
        """Return the value's node, or None where the key is missing or empty."""
        node = self.get(key, False)
        return None if node is None or node.value is None else node

    def text(self, key: str, default: str | None = None, choices: Iterable[str] = ()) -> str:
        """Return the text of `key`, one of `choices` where there are any. Raises InputError."""
        node = self.get(key, default is None)
        if node is None:
            return default or ""
        if not isinstance(node.value, str):
            raise node.error(f"{self.label(key)}: text was expected, found {kind_of(node)}")
        if choices and node.value not in choices:
            raise node.error(
                f"{self.label(key)}: '{node.value}' is not one of {', '.join(choices)}"
                f"{suggest(node.value, choices)}"
            )
        return node.value

    def number(
        self, key: str, default: float | None = None, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Return the number of `key` within low..high. Raises InputError."""
        node = self.get(key, default is None)
        return float(default or 0.0) if node is None else number_of(node, self.label(key), low, high)

    def optional_number(self, key: str, low: float = -math.inf) -> float | None:
        """Return the number of `key`, `low` at least, None where it is missing or empty.

        Raises InputError."""
        node = self.given(key)
        return None if node is None else number_of(node, self.label(key), low)

    def integer(self, key: str, default: int | None = None, low: int = 0, high: int = 2**32) -> int:
        """Return a whole number; text like '0x6041' is hexadecimal. Raises InputError."""
        node = self.get(key, default is None)
        return int(default or 0) if node is None else integer_of(node, self.label(key), low, high)

    def flag(self, key: str, default: bool) -> bool:
        """Return true or false of `key`. Raises InputError."""
        node = self.get(key, False)
        if node is None:
            return default
        if not isinstance(node.value, bool):
            raise node.error(f"{self.label(key)}: true or false was expected, found {kind_of(node)}")
        return node.value

    def interval(self, key: str) -> tuple[float, float]:
        """Return the pair [low, high] of `key`, unbounded where it is missing. Raises InputError."""
        node = self.get(key, False)
        if node is None:
            return -math.inf, math.inf
        label = self.label(key)
        if not isinstance(node.value, list) or len(node.value) != 2:
            more = isinstance(node.value, list) and len(node.value) > 2
            hint = " of more items (write decimals with a point: 0.5)" if more else ""
            raise node.error(f"{label}: two numbers [low, high] were expected, found {kind_of(node)}{hint}")
        low, high = (number_of(n, label) for n in node.value)
        if not low < high:
            raise node.error(
                f"{label}: [{low:g}, {high:g}] is empty; [low, high] with low < high was expected"
            )
        return low, high

    def list(self, key: str, required: bool = True) -> list[Node]:
        """Return the list of `key`, empty where it is neither required nor there. Raises InputError."""
        node = self.get(key, required)
        if node is None:
            return []
        if not isinstance(node.value, list):
            raise node.error(f"{self.label(key)}: a list was expected, found {kind_of(node)}")
        return node.value

    @overload
    def section(self, key: str, required: Literal[True] = True) -> Section: ...
    @overload
    def section(self, key: str, required: bool) -> Section | None: ...

    def section(self, key: str, required: bool = True) -> Section | None:
        """Return the mapping below `key`, None where it is neither required nor there. Raises InputError."""
        node = self.get(key, required)
        return None if node is None else Section(node, key)

    def sections(self, key: str) -> dict[str, Section]:
        """Return the mapping of names to mappings below `key`. Raises InputError."""
        inner = Section(self.get(key), key)
        for name, node in inner.node.value.items():
            if not _NAME.match(name):
                raise node.error(f"{key}: '{name}' is no name (letters, digits and _)")
        return {name: Section(node, name) for name, node in inner.node.value.items()}

    def end(self) -> None:
        """Raise InputError at a key that was not read."""
        for key, node in self.node.value.items():
            if key not in self.asked:
                raise node.error(
                    f"{self.what}: unknown key '{key}'{suggest(key, self.asked)}; "
                    f"known here: {', '.join(sorted(self.asked))}"
                )


_NAME = re.compile(r"[A-Za-z_]\w{0,59}$", re.ASCII)


def kind_of(node: Node) -> str:
    """Return the kind of a node's value in words, for an error."""
    v = node.value
    if isinstance(v, dict | list):
        return "a mapping" if isinstance(v, dict) else "a list"
    return "nothing" if v is None else repr(v)[:80]


def _hexadecimal(value: Any) -> Any:
    """Return the number of text such as 0x7FFF; any other value as it is."""
    if isinstance(value, str) and re.fullmatch(r"[-+]?0[xX][0-9A-Fa-f]{1,16}", value):
        return int(value, 16)
    return value


def number_of(
    node: Node, label: str, low: float = -math.inf, high: float = math.inf, unit: str = ""
) -> float:
    """Return a node's number within low..high; `label` and `unit` describe it in the InputError."""
    value = _hexadecimal(node.value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_NUMBER:
        in_unit = f" in {unit}" if unit else ""
        if said := decimal_comma(str(value)):
            raise node.error(f"{label}: {said}")
        raise node.error(f"{label}: a number{in_unit} was expected, found {kind_of(node)}")
    if not low <= value <= high:
        raise node.error(f"{label}: {value:g} is outside {low:g} .. {high:g} {unit}".rstrip())
    return float(value)


def integer_of(node: Node, label: str, low: int = 0, high: int = 2**32) -> int:
    """Return a node's whole number within low..high; `label` names it in the InputError."""
    value = _hexadecimal(node.value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise node.error(f"{label}: a whole number was expected, found {kind_of(node)}")
    if not low <= value <= high:
        raise node.error(f"{label}: {value} is outside {low} .. {high}")
    return value
