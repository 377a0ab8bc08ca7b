"""Map a template's inputs and outputs to a recording's columns, by kind and by the place in their names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import permutations

from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant.files import loads
from thermoctl.plant.first.columns import UNITS, Column, quoted, words
from thermoctl.plant.first.thermal import confirm
from thermoctl.plant.language import Input, Output, Plant
from thermoctl.recording.table import Table
from thermoctl.units import dimension

TEMPLATES = ("block", "motor", "hot-end", "room", "tank", "stage", "flexure", "actuator")
# Words for the same place in several languages, one place a line.
_PLACES = (
    "winding wicklung bobinage enroulement avvolgimento bobinado devanado wikkeling coil spule bobine bobina stator",
    "housing gehause gehaeuse carter boitier carcasa alloggiamento behuizing case casing frame body",
    "block bloc blocco bloque blok hotend nozzle extruder duse duese",
    "core kern noyau nucleo anker",
    "room raum salle stanza sala kamer zimmer indoor inside innen interieur interno interior living wohnzimmer",
    "fan lufter luefter ventilateur ventola ventilador",
    "bed bett heizbett druckbett plate lit letto cama",
)
_FAN = 5
SAME = 1.5  # least score at which two names mean the same place
_MOST = 7  # up to so many columns of one kind are tried in every order


def text(name: str) -> str:
    """Return a template's text. Raises InputError for an unknown name."""
    if name not in TEMPLATES:
        raise InputError(f"no template '{name}'{suggest(name, TEMPLATES)}; there are {', '.join(TEMPLATES)}")
    return (shipped("config/plants/templates") / f"{name}.yaml").read_text(encoding="utf-8")


def mapped(
    name: str, table: Table, columns: Mapping[str, Column], chosen: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Return a template's text with the columns of a table, and the names of the unused columns.

    `chosen`: column by the template's name, from --columns. Raises InputError for an input without one."""
    content = text(name)
    plant = loads(content, name)
    for own in chosen:
        if own not in {r.name for r in plant.readings()}:
            raise InputError(
                f"--columns {own}: template '{name}' has no such input or output{suggest(own, [r.name for r in plant.readings()])}"
            )
    assigned = _assigned(plant, columns, chosen)
    optional = [i for i in plant.inputs.values() if i.role == "ambient" or _is_fan(i.name)]
    lacking = [i for i in plant.inputs.values() if i.name not in assigned and i not in optional]
    if lacking:
        raise InputError(
            f"{table.path}: template '{name}' reads '{lacking[0].name}' [{lacking[0].unit}]; no column is recognised as it "
            f"(columns {', '.join(table.columns)}): name it with --columns {lacking[0].name}=COLUMN"
        )
    if not any(o in assigned for o in plant.outputs):
        wanted = ", ".join(f"{o.name} [{o.unit}]" for o in plant.outputs.values())
        raise InputError(
            f"{table.path}: no column is recognised as an output of template '{name}' ({wanted}); name one with "
            f"--columns {next(iter(plant.outputs))}=COLUMN"
        )
    for item in plant.readings():
        if item.name in assigned:
            content = _with_column(content, item, assigned[item.name], item.name in chosen)
        elif isinstance(item, Input) and item.role == "ambient":
            warm = [
                assigned[o].values(table)[0]
                for o in plant.outputs
                if o in assigned and _kind(plant.outputs[o]) == "temperature"
            ]
            content = _fixed(content, item, min(map(float, warm)), "temperature of the air")
        elif isinstance(item, Input):
            content = _fixed(content, item, 0.0, f"no column is recognised as '{item.name}': off")
        else:
            content = _without_output(content, item, next(o for o in plant.outputs if o in assigned))
    used = {c.name for c in assigned.values()}
    return content, [c for c in table.columns if c not in used]


def _assigned(plant: Plant, columns: Mapping[str, Column], chosen: Mapping[str, str]) -> dict[str, Column]:
    """Return the column of each input and output: the assignment with the largest score."""
    assigned = {own: columns[c] for own, c in chosen.items()}
    free = [c for c in columns.values() if c not in assigned.values()]
    groups = dict.fromkeys((_kind(r), r.role == "ambient") for r in plant.readings())
    # The surroundings first, which are no body; drives last, since their names may repeat those of bodies.
    for group in sorted(groups, key=lambda g: (not g[1], g[0] != "temperature")):
        bodies = [
            set(words(c.name))
            for own, c in assigned.items()
            if c.kind == "temperature" and own in plant.outputs
        ]
        items = [
            r for r in plant.readings() if r.name not in assigned and (_kind(r), r.role == "ambient") == group
        ]
        fits = [c for c in free if _fits(c, *group)]
        if group[1]:  # the surroundings: the column furthest out
            fits = sorted((c for c in fits if c.outside), key=lambda c: -c.outside)[:1]
        elif group[0] == "temperature":
            inner = [c for c in fits if not c.outside]
            outer = [c for c in fits if c.outside and any(_score(i, c) > SAME for i in items)]
            fits = inner if len(inner) >= len(items) else [*inner, *outer]
        fits = fits[:_MOST]
        best = max(
            permutations([*fits, *[None] * len(items)], len(items)),
            key=lambda p: sum(_score(r, c) + _shared(c, bodies) for r, c in zip(items, p, strict=True)),
            default=(),
        )
        assigned |= {r.name: c for r, c in zip(items, best, strict=True) if c is not None}
        free = [c for c in free if c not in assigned.values()]
    return assigned


def _kind(item: Input | Output) -> str:
    if item.role == "level":
        return "level"
    wanted = dimension(item.unit or "1")
    return next(
        k for k, u in UNITS.items() if dimension(u) == wanted and (k != "angle" or item.unit == "rad")
    )


def _fits(c: Column, kind: str, ambient: bool) -> bool:
    if kind in ("angle", "duty"):  # a share: of a heater or of a fan
        return c.kind in ("duty", "power") and c.unit in ("", "%", "1") or (c.kind == "" and _is_fan(c.name))
    if ambient:
        return c.kind == kind and bool(c.outside)
    return c.kind == kind


def _shared(c: Column | None, bodies: Sequence[set[str]]) -> float:
    """Return the part of a column's score for words that its name shares with the names of bodies."""
    return 0.2 * max((len(set(words(c.name)) & b) for b in bodies), default=0) if c else 0.0


def _is_fan(name: str) -> bool:
    return bool(set(words(name)) & set(_PLACES[_FAN].split()))


def _score(item: Input | Output, c: Column | None) -> float:
    """Return a score of how well a column's name fits an item's name: same place, same word, neither."""
    if c is None:
        return 0.0
    own, its = set(words(item.name)), words(c.name)
    if _is_fan(item.name) != _is_fan(c.name):
        return -1.0  # rather none
    places = [set(p.split()) for p in _PLACES]
    same = any(own & p and any(w in p or any(len(q) > 4 and q in w for q in p) for w in its) for p in places)
    other = any(not own & p and any(w in p for w in its) for p in places)
    return (
        (1.7 if c.kind == "duty" else 1.0)
        + (2.0 if same else 0.0)
        + (1.0 if own & set(its) else 0.0)
        - (0.5 if other and not same else 0.0)
    )


def _with_column(content: str, item: Input | Output, c: Column, chosen: bool) -> str:
    """Return the text with `column` in an item's line, and `# confirm` with the guess as its comment."""
    match = _line(content, item.name)
    odd = bool(c.unit) and not c.stated and c.unit != item.unit
    column = f"{{name: {quoted(c.name)}, unit: {quoted(c.unit)}}}" if odd else quoted(c.name)
    keys = "" if c.name == item.name and not odd else f", column: {column}"
    doubt = c.doubt or ("" if chosen or c.name == item.name else f"'{c.name}' is '{item.name}'")
    return content.replace(match[0], f"{match[1]}{keys}{match[2]}{confirm(doubt) or match[3]}", 1)


def _fixed(content: str, item: Input, value: float, what: str) -> str:
    """Return the text with an input that was not recorded as a parameter."""
    content = content.replace(_line(content, item.name)[0] + "\n", "", 1)
    line = f"parameters:\n  {item.name}: {{value: {value:.4g}, unit: {quoted(item.unit or '1')}}}  # confirm: {what}\n"
    return content.replace("parameters:\n", line, 1)


def _without_output(content: str, item: Output, other: str) -> str:
    """Return the text without an output; its node starts like that of `other`."""
    content = content.replace(_line(content, item.name, "value:")[0] + "\n", "", 1)
    return content.replace(f"first({item.name})", f"first({other})")


def _line(content: str, name: str, holds: str = "") -> re.Match[str]:
    """Return the match of an item's line: up to the closing brace, the brace, the comment."""
    match = re.search(
        rf"^(  {re.escape(name)}: \{{{holds}[^\n]*?)(\}})([ ]*(?:#[^\n]*)?)$", content, re.MULTILINE
    )
    assert match is not None
    return match
