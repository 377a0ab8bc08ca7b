"""The command `effects check`: mistakes in effect files, each with its place in the file.

The reader of the catalogue takes a file as it is; an expression with an unknown name would then be an effect
that fits nowhere. This check reads a file key by key, and puts the effect at every place of some plants.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from thermoctl import yamlfile
from thermoctl.diagnosis.hypothesis.candidates import Candidate, candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, OWN, _read
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import Plant, expression, load
from thermoctl.plant.simulate import Excitation
from thermoctl.plant.units import check_units
from thermoctl.shipped import shipped
from thermoctl.units import dimension
from thermoctl.yamlfile import InputError, Node, Section, suggest

SYMBOLS: Mapping[str, tuple[str, ...]] = {
    "node": ("n",),
    "node_pair": ("m", "n"),
    "temperature_node": ("T",),
    "velocity_node": ("v",),
    "conductance": ("T",),
    "temperature_pair": ("TA", "TB"),
    "heated_pair": ("TA", "TB", "a", "b"),
    "joule_flow": ("T",),
    "motor": ("v",),
    "drive": ("u",),
    "sensor": ("y",),
    "body_sensor": ("y",),
    "passive_sensor": ("y",),
    "reading_in_air": ("y",),
    "position_sensor": ("y",),
    "displacement": ("y",),
    "member": ("y", "T"),
    "bending_pair": ("y", "TA", "TB"),
    "voltage_sensor": ("y", "a"),
    "level_node": ("a", "b"),
    "orifice": (),
    "resistive": (),
    "fixed_node": ("T",),
    "fixed_flow": (),
}
"""The symbols of each place that an effect's expressions may read; its nodes are also ends of flows."""
EVERYWHERE = ("air", "reference", "duration", "sample", "t")
NEEDS = ("x", "v", "i", "T")
SHAPES: Mapping[str, tuple[str, ...]] = {
    "onsets": ("onset",),
    "windows": ("start", "end"),
    **dict.fromkeys(("times", "lags", "delays"), ("tau",)),
    "periods": ("period",),
    "phases": ("phase",),
    **dict.fromkeys(("end_levels", "high_levels", "drive_levels", "small_levels"), ("level",)),
    "speeds": ("speed",),
    "creep_speeds": ("creep",),
    "distances": ("distance",),
}
"""The kinds of shapes, and the names of the values that each gives to parameters and trials."""
FORMS = ("rate", "value", "storage", "drive", "resistance")
PARTS = {
    "flow": (("rate",), ("from", "into")),
    "node": (("name", "storage", "initial"), ("unit", "initial_sigma")),
    "split": (("from", "into", "share"), ()),
    "spill": (("from", "into", "level", "share"), ()),
}
"""The keys of a change that is a mapping: required ones, others."""
_STARTS = ("start_of_T", "start_of_y", "start_of_x", "first_air")


def check_file(path: Path, plants: Sequence[Plant]) -> tuple[str, list[str]]:
    """Check one effect file; return the effect's name and the places of `plants` where it sits.

    Raises InputError with file, line and column at the first mistake."""
    root = yamlfile.load(path)
    name, where = _structure(root)
    effect = _read(root)
    places = []
    for plant in plants:
        for c in candidates(made_rig(plant), {name: effect}):
            label = f"{where} '{c.place.where}' of {plant.file}"
            _try(root, c, label)
            if (place := f"{Path(plant.file).name}: {c.place.where}") not in places:
                places.append(place)
    return name, places


def made_rig(plant: Plant) -> Rig:
    """Return a plant with a made recording in which every input moves, so that every place is found."""
    t = 0.5 * np.arange(80)  # not 1 s: a division by it would vanish, and the units with it
    u = np.array([20.0 + np.where(t > 3 * k + 3, 1.0, 0.0) for k in range(len(plant.inputs))])
    first = {i: 20.0 for i in (*plant.inputs, *plant.outputs)}
    y = np.full((len(t), len(plant.outputs)), np.nan)
    linear = np.array([i.linear for i in plant.inputs.values()], np.intc)
    excitation = Excitation("made", t, u.T.reshape(len(t), len(plant.inputs)), y, first, linear)
    columns = {i.column: q for i, q in zip(plant.inputs.values(), u, strict=True)}
    return Rig(plant, [excitation], [columns])


def own_plants() -> list[Plant]:
    """Return the templates and the actuator: between them they have most kinds of places."""
    folder = shipped("config/plants")
    return [load(p) for p in (*sorted((folder / "templates").glob("*.yaml")), folder / "actuator.yaml")]


# ------------------------------------------------------------------------------------------------ the file


def _structure(root: Node) -> tuple[str, str]:
    top = Section(root, "an effect file")
    name, where = top.text("effect"), top.text("where", choices=SYMBOLS)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise top.get("effect").error(f"'{name}': a name of small letters, digits and '_' was expected")
    _words(top)
    needs = []
    for node in top.list("needs", required=False):
        if node.value not in NEEDS:
            raise node.error(f"needs: one of {', '.join(NEEDS)} was expected, found {yamlfile.kind_of(node)}")
        needs.append(str(node.value))
    given = _shapes(top)
    parameters = top.sections("parameters")
    amplitudes = [n for q, p in parameters.items() for n in _parameter(q, p, given, parameters)]
    _dims(top, amplitudes)
    reads = [str(node.value) for node in top.list("reads", required=False)]
    known = {*SYMBOLS[where], *needs, *reads, *EVERYWHERE, *parameters}
    prior = top.given("prior")
    if prior:
        _expression(prior, {*parameters, "duration", "first_air"}, "prior")
    _lists_of_changes(top, known, set(parameters), where)
    top.end()
    return name, where


def _words(top: Section) -> None:
    for key in ("title", "source"):
        top.text(key)
    for key in ("excited_by", "caution", "contains"):
        top.text(key, "")
    for node in top.list("mimics", required=False):
        if not isinstance(node.value, str):
            raise node.error("mimics: names of effects were expected")


def _shapes(top: Section) -> set[str]:
    """Return the names of the values that the effect's shapes give."""
    section = top.section("shapes", required=False)
    found: set[str] = set()
    for key in section.node.value if section else ():
        assert section is not None
        found.update(SHAPES[section.text(key, choices=SHAPES)])
    return found


def _parameter(name: str, p: Section, given: set[str], parameters: Mapping[str, Section]) -> list[str]:
    """Check a parameter; return the amplitudes (s, s2 ...) of its trial value."""
    low, high = p.number("low", -np.inf), p.number("high", np.inf)
    if not low <= high:  # equal: a known value
        raise p.node.error(f"parameter '{name}': low {low:g} must not be above high {high:g}")
    for key in ("null", "typical"):
        p.optional_number(key)
    p.flag("per_recording", False)
    p.text("origin", "none", choices=("none", "first_air", "exponent"))
    p.text("of", "none", choices=("none", "jump"))
    p.flag("at_zero", False)
    unit = p.text("unit")
    if not unit.startswith("unit_of") and not re.search(r"\bunit_of_\w+", unit):
        try:
            dimension(unit)
        except ValueError as e:
            raise p.get("unit").error(f"parameter '{name}': {e}") from None
    shape, trial = p.given("shape"), p.given("trial")
    if shape is not None and shape.value not in given:
        raise shape.error(
            f"parameter '{name}': shape '{shape.value}' is none of this effect's shapes ({', '.join(sorted(given)) or 'none'})"
        )
    p.end()
    if trial is None:
        return [] if shape is not None else ["s"]
    steps = {f"s{k}" for k in range(2, 10)} | {"s"}
    _expression(trial, {*steps, *given, "first_air", "exponent", *parameters}, f"trial of '{name}'")
    return sorted(expression.names(expression.parse(trial.value)) & steps)


def _dims(top: Section, amplitudes: Iterable[str]) -> None:
    count = max((int(n[1:] or 1) for n in amplitudes), default=0)
    for row in top.list("dims", required=False):
        if not isinstance(row.value, list) or len(row.value) != count:
            raise row.error(f"dims: rows of {count} numbers were expected, one for each amplitude s, s2 ...")


def _expression(node: Node, known: Iterable[str], what: str) -> None:
    if isinstance(node.value, dict | list):
        raise node.error(f"{what}: an expression was expected, found {yamlfile.kind_of(node)}")
    try:
        read = expression.parse(node.value)
    except expression.ExpressionError as e:
        raise node.error(f"{what}: {e}") from None
    allowed = sorted(set(known))
    for n in sorted(expression.names(read) - set(allowed)):
        raise node.error(
            f"{what}: '{n}' is not known here{suggest(n, allowed)}; allowed are {', '.join(allowed)}"
        )


def _lists_of_changes(top: Section, known: set[str], parameters: set[str], where: str) -> None:
    variants = top.list("variants", required=False)
    for node in variants:
        if not isinstance(node.value, list):
            raise node.error("variants: a list of changes was expected for each")
    for changes in (top.list("change"), *(v.value for v in variants)):
        if not changes:
            raise top.get("change").error("change: at least one change was expected, such as {flow: {...}}")
        _changes(changes, known, parameters, where)


def _changes(changes: Sequence[Node], known: set[str], parameters: set[str], where: str) -> None:
    made: set[str] = set()
    for item in changes:
        if not isinstance(item.value, dict) or len(item.value) != 1:
            raise item.error("change: one mapping for each change was expected, such as {flow: {...}}")
        ((kind, node),) = item.value.items()
        if kind in FORMS:
            _expression(node, {*known, *made, *({OWN[kind]} if kind in OWN else ())}, kind)
        elif kind in PARTS:
            _part(kind, node, {*known, *made}, made, parameters, where)
        elif kind == "straight":
            if node.value not in known:
                raise node.error(f"straight: a symbol was expected, one of {', '.join(sorted(known))}")
        elif kind == "exponent":
            if node.value not in parameters:
                raise node.error(
                    f"exponent: a parameter was expected, one of {', '.join(sorted(parameters))}"
                )
        else:
            kinds = (*FORMS, *PARTS, "straight", "exponent")
            raise node.error(
                f"'{kind}' is not a change{suggest(kind, kinds)}; one of {', '.join(kinds)} was expected"
            )


def _part(kind: str, node: Node, known: set[str], made: set[str], parameters: set[str], where: str) -> None:
    section = Section(node, kind)
    required, others = PARTS[kind]
    for key in (*required, *others):
        value = section.get(key, key in required)
        if value is None:
            continue
        if key in ("from", "into"):
            ends = sorted({*SYMBOLS[where], *made} - {"u", "y"})
            if value.value not in ends:
                raise value.error(
                    f"{kind}: '{value.value}' is not a node of the place; {', '.join(ends) or 'none'} was expected"
                )
        elif key in ("rate", "storage") or (key == "initial" and value.value not in _STARTS):
            _expression(value, known, f"{key} of {kind}")
        elif key in ("share", "level") and value.value not in parameters:
            raise value.error(f"{kind}: {key} is a parameter, one of {', '.join(sorted(parameters))}")
    if kind == "flow" and not {"from", "into"} & set(node.value):
        raise node.error("flow: 'from' or 'into' was expected")
    if kind == "node":
        made.add(section.text("name"))
    section.end()


# ---------------------------------------------------------------------------------------------- at a place


def _try(root: Node, c: Candidate, label: str) -> None:
    """Extend the plant by the effect and check the units. Raises InputError at the effect's change."""
    change = root.value["variants"].value[c.variant - 1] if c.variant else root.value["change"]
    values = {
        p.name: p.typical if p.typical is not None else max(p.low, min(p.high, p.null))
        for p in c.effect.parameters
    }
    try:
        check_units(dataclasses.replace(c.extend(values), file=label))
    except (InputError, expression.ExpressionError, KeyError) as e:
        told = re.sub(r"^.*?:\d+:\d+: ", "", str(e))
        raise change.error(f"at {label}: {told}") from None


def files_of(paths: Sequence[str]) -> Iterator[Path]:
    """Yield the effect files of files and folders. Raises InputError for a folder without one."""
    for path in map(Path, paths or [str(CATALOGUE)]):
        found = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
        if not found:
            raise InputError(f"{path}: no effect files (*.yaml) here")
        yield from found
