"""Write the generated parts of law.pxd: C types of the law's constants, of the parameters and of its state.

    python -m tests.typed [--check]

With --check nothing is written; exit status 1 and one line when the file differs. The names come from law.py
and from Parameters, so a new limit, constant or state variable is declared once.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from types import ModuleType

from thermoctl.control import model
from thermoctl.control.model import BY_CHANNEL, Parameters

CONTROL = Path(model.__file__).parent
_WIDTH = 110
_INT_BITS = 31
_PART = re.compile(r"^( *)# generated: (.*)\n(?:.*\n)*?\1# end\n", re.MULTILINE)


def interpreted_law() -> ModuleType:
    """Return law.py as an interpreted module: the compiled one hides its constants."""
    spec = importlib.util.spec_from_file_location("interpreted_law", CONTROL / "law.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _lines(kind: str, names: Iterable[str], indent: str) -> list[str]:
    """Return declarations of the names, as many as fit on each line."""
    lines: list[str] = []
    for name in names:
        if lines and len(lines[-1]) + len(name) + 2 <= _WIDTH:
            lines[-1] += f", {name}"
        else:
            lines.append(f"{indent}cdef {kind} {name}")
    return lines


def _kind(value: object) -> str:
    """Return the C type of a constant, '' for one that stays Python's."""
    if isinstance(value, bool | int):
        return "int" if int(value).bit_length() <= _INT_BITS else "bits_t"
    return {float: "double", bytes: "const uint8_t[::1]"}.get(type(value), "")


def parts(law: ModuleType) -> dict[str, list[tuple[str, list[str]]]]:
    """Return the generated parts by title, each as (C type, names)."""
    constants = [(name, _kind(value)) for name, value in vars(law).items() if re.match(r"_[A-Z]", name)]
    kinds = ("int", "bits_t", "double", "const uint8_t[::1]")
    whole = [name for name in law._SCALARS if name in law._WHOLE and name != "latched"]
    return {
        "the constants of law.py": [(k, [n for n, kind in constants if kind == k]) for k in kinds],
        "the fields of Parameters": [
            ("public double", [f.name for f in fields(Parameters) if f.name not in BY_CHANNEL])
        ],
        "the arrays of Parameters": [("public double[::1]", list(BY_CHANNEL))],
        "the state that snapshot() holds": [
            ("public long long", whole),
            ("public bits_t", ["latched"]),
            ("public double", [name for name in law._SCALARS if name not in law._WHOLE]),
            ("public double[::1]", list(law._VECTORS)),
        ],
    }


def declarations(text: str, law: ModuleType) -> str:
    """Return the text of law.pxd with its generated parts rewritten. Raises KeyError for an unknown part."""
    made = parts(law)

    def write(match: re.Match[str]) -> str:
        """Return a generated part with its first and last line. Raises KeyError for an unknown title."""
        indent, title = match[1], match[2]
        lines = [line for kind, names in made[title] for line in _lines(kind, names, indent)]
        return "\n".join([f"{indent}# generated: {title}", *lines, f"{indent}# end\n"])

    return _PART.sub(write, text)


def main(arguments: list[str]) -> int:
    """Write law.pxd, or with --check report whether it is up to date."""
    path = CONTROL / "law.pxd"
    text = path.read_text(encoding="utf-8")
    made = declarations(text, interpreted_law())
    if "--check" in arguments:
        if made != text:
            print(f"{path}: not up to date; run `python -m tests.typed`, then `make install`")
        return int(made != text)
    path.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
