"""A law in the result: its entry in diagnosis.json, its section of the report, its effect file."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.evidence.held_out import Worth
from thermoctl.diagnosis.evidence.where import along
from thermoctl.diagnosis.hypothesis.rig import zero_of
from thermoctl.diagnosis.law.find import FoundLaw
from thermoctl.diagnosis.law.forms import MARK
from thermoctl.diagnosis.law.propose import Proposal
from thermoctl.diagnosis.law.refit import equation, law_rate, laws_of, plain
from thermoctl.diagnosis.report.figures import WIDE, every_law, parameter_rows
from thermoctl.diagnosis.report.words import law_sentence
from thermoctl.files.safe_file import make_folder, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.language import Plant
from thermoctl.report.page import BLUE, FAINT, GREY, items, panel, panels, paragraph, table, unit

SAME = 0.05  # largest difference of two flows that are taken for one, over their size


def law_entry(laws: Sequence[FoundLaw], worth: Worth) -> dict[str, Any] | None:
    """Return `remainder.law` of diagnosis.json: the first law, with the others `beside` it."""
    if not laws:
        return None
    law, *others = laws
    f, p, place = law.fitted, law.proposal, law.proposal.place
    return {
        "where": place.where,
        "part": place.part,
        "expression": equation(f, law.placed),
        "plain": plain(f, law.placed),
        "into": None if place.part == "reading" else place.target,
        "from": place.source,
        "shares": {node: str(share) for node, share in place.shares},
        "terms": [str(t.expression(k)) for k, t in enumerate(p.terms, 1)],
        "forms": _terms(p),
        "memory": {f"m{k}": t.memory_text(k) for k, t in enumerate(p.terms, 1) if t.form.memory},
        "of": sorted({s.label for t in p.terms for s in t.signals}),
        "parameters": _parameters(law),
        "probability": round(law.probability, 4),
        "confirmed": round(law.confirmed, 4),
        "gain": law.gain,
        "rms": f.fit.rms(),
        "share_closed": worth.share_closed,
        "held_out": worth.reserved,
        "equivalent": family(law),
        "effect": None if place.of or place.part == "reading" else effect_file(law),
        "beside": [law_entry([other], worth) for other in others],
    }


def _terms(p: Proposal) -> list[dict[str, Any]]:
    """Return form and signals of each term, and the names of its parameters."""
    return [
        {
            "form": t.form.name,
            "variables": [s.label for s in t.signals],
            "sizes": {q: f"{q}{k}" for q in t.form.sizes},
            "shapes": {q: f"{q}{k}" for q in t.form.shapes},
        }
        for k, t in enumerate(p.terms, 1)
    ]


def _parameters(law: FoundLaw) -> dict[str, Any]:
    plant, sd = law.fitted.plant, law.fitted.sd
    return {
        short: {"value": plant.parameters[q].value, "sd": sd.get(q), "unit": plant.parameters[q].unit}
        for short, q in law.placed.candidate.own_in(plant).items()
    }


def family(law: FoundLaw) -> list[str]:
    """Return sentences on laws that the recordings cannot tell apart: intervals of shapes, and rivals."""
    out = []
    c, plant = law.placed.candidate, law.fitted.plant
    for k, t in enumerate(law.proposal.terms, 1):
        for q in t.form.shapes:
            long = c.own(f"{q}{k}")
            value, sd = plant.parameters[long].value, law.fitted.sd.get(long, 0.0)
            of = ", ".join(s.label for s in t.signals)
            out.append(
                f"{q}{k} of the {t.form.name.replace('_', ' ')} in {of}: {value - WIDE * sd:.3g} to {value + WIDE * sd:.3g}"
            )
    return out + [
        f"{described(p, f)} fits about as well (probability {share:.2f})" for p, f, share in law.rivals
    ]


def described(p: Proposal, f: Fitted) -> str:
    """Return a law as an expression with numbers, and its place."""
    return f"{equation(f, laws_of(f)[0], numbers=True)} at {p.place.where}"


def wrong_ends(case: Case, law: FoundLaw) -> list[str]:
    """Return a sentence for a flow of the plant that the law only leads to, or takes from, another node.

    The law reads the signals of the flow then: near a balance, flows of other signals are as large."""
    place, model = law.proposal.place, law.fitted.fit.model
    drives = case.drives(model)
    own, out = law_rate(law.fitted, law.placed), []
    for f in model.plant.flows.values():
        if not place.source or (f.target == place.source) == (f.source == place.target):
            continue
        if not ex.names(f.rate) - model.plant.parameters.keys() <= ex.names(own):
            continue
        moved, whole = [], []
        for d, names in zip(drives, along(law.fitted.fit, drives), strict=True):
            moved.append(ex.series(own, names, d.t))
            whole.append(ex.series(f.rate, names, d.t))
        apart = np.concatenate(moved) - np.concatenate(whole)
        if np.linalg.norm(apart) < SAME * np.linalg.norm(np.concatenate(whole)):
            what, right, wrong = (
                ("end in", *place.nodes[::-1]) if f.target == place.source else ("start at", *place.nodes)
            )
            out.append(
                f"the law moves all of the flow '{f.name}' from {place.source} to {place.target}: the flow seems to {what} "
                f"{right}, and not {wrong}, as the plant file says"
            )
    return out


def law_section(laws: Sequence[FoundLaw], result: Mapping[str, Any]) -> str:
    """Return the report's section: each law, its parameters, its family, and the curve with its band."""
    drawn = [_drawn(law, e) for law, e in zip(laws, every_law(result), strict=True)]
    saved = paragraph("thermoctl effects save DIR NAME writes each as an effect of your own catalogue.")
    return "".join([*drawn, saved]) if drawn else ""


def _drawn(law: FoundLaw, entry: Mapping[str, Any]) -> str:
    body = f"{paragraph(law_sentence(entry))}<pre>{html.escape(entry['expression'])}</pre>"
    heads, rows = parameter_rows(entry)
    body += table(heads, [(n, value, unit(of)) for n, value, of in rows])
    return body + items(entry["equivalent"]) + _drawing(law)


def _drawing(law: FoundLaw) -> str:
    c = law.curve
    if c is None:
        return ""
    axes = panel()
    band = (c.flow - WIDE * c.sd, c.flow + WIDE * c.sd)
    axes.fill_between(c.at, *band, color=FAINT, lw=0)
    axes.plot(c.at, c.flow, ".", color=GREY, label="any function, and its 95 %")
    axes.plot(c.at, c.law, color=BLUE, label="law")
    axes.set_xlabel(f"{c.signal.label} ({unit(c.signal.unit)})" if c.signal.unit else c.signal.label)
    axes.set_ylabel(f"flow ({unit(law.unit)})" if law.unit else "flow")
    return panels(
        [axes],
        "The flow as a free function of the signal, and the law. Parts that the plant's own parameters absorb are the law's.",
    )


# ------------------------------------------------------------------------------------------------ effect file


def effect_file(law: FoundLaw) -> dict[str, Any]:
    """Return the content of an effect file. Its sizes are refitted, its shapes start at the fitted values."""
    c, plant = law.placed.candidate, law.fitted.plant
    where, ends, symbols = _symbols(law, plant)
    changes = [_general(item, symbols, ends) for item in c.effect.changes[0]]
    rates = [what if isinstance(what, str) else what.get("rate", "0") for x in changes for what in x.values()]
    read = set().union(*(ex.names(ex.parse(rate)) for rate in rates))
    reads = sorted(read & (plant.inputs.keys() | plant.nodes.keys()))
    variables = ", ".join(sorted({s.label for t in law.proposal.terms for s in t.signals}))
    return {
        "effect": "law",
        "title": f"Law over {variables}, proposed from recordings",
        "where": where,
        **({"needs": ["x"]} if where == "velocity_node" and "x" in read else {}),
        **({"reads": reads} if reads else {}),
        "change": changes,
        "parameters": _general_parameters(law),
        "excited_by": f"the visited range of {variables}",
        "source": f"thermoctl diagnose of {Path(plant.file).name}",
    }


def _general_parameters(law: FoundLaw) -> dict[str, Any]:
    """Return the parameters of an effect file: sizes with a trial value of s, s2 ..., and fitted shapes."""
    c, out, sizes = law.placed.candidate, dict[str, Any](), 0
    for q in c.effect.parameters:
        p = law.fitted.plant.parameters.get(c.own(q.name))
        if p is None:
            continue
        if q.amplitude:
            sizes += 1
            trial = "s" if sizes == 1 else f"s{sizes}"
            out[q.name] = {**({"unit": p.unit} if p.unit else {}), "trial": trial}
        else:
            low, high = p.range or (p.value, p.value)
            shape = {"trial": repr(p.value), "null": p.value, "low": low, "high": high}
            out[q.name] = {"unit": p.unit or "1", **shape}
    return out


def _general(
    change: Mapping[str, Any], symbols: Mapping[str, Expr], ends: Mapping[str, str]
) -> dict[str, Any]:
    """Return a change of an effect with the symbols of an effect file."""

    def in_symbols(text: str) -> str:
        """Return an expression with the symbols of an effect file."""
        e = ex.parse(text)
        bare = {n: n.removeprefix(MARK) for n in ex.names(e) if n.startswith(MARK)}
        return str(ex.fill(e, {n: symbols.get(own, name(own)) for n, own in bare.items()}))

    ((kind, what),) = change.items()
    if isinstance(what, str):
        return {kind: in_symbols(what)}
    out = {k: in_symbols(v) if k in ("rate", "initial") else v for k, v in what.items()}
    return {kind: {k: ends.get(v, v) if k in ("into", "from") else v for k, v in out.items()}}


def _symbols(law: FoundLaw, plant: Plant) -> tuple[str, dict[str, str], dict[str, Expr]]:
    """Return the kind of place, the ends of its flow, and the expression of each name of the plant.

    Ends and expressions are in the symbols of an effect file."""
    place, rig = law.proposal.place, law.placed.candidate.rig
    target = place.target
    if place.source:
        ends = {"target": "n", "source": "m"}
        return "node_pair", ends, {target: name("n"), place.source: name("m")}
    if target in rig.temperatures and rig.air:
        air = plant.inputs.get(rig.air) or plant.parameters[rig.air]
        of = {target: ("T", plant.nodes[target].unit), rig.air: ("air", air.unit)}
        celsius = {n: ex.add(name(s), num(zero_of(its_unit))) for n, (s, its_unit) in of.items()}
        return "temperature_node", {"target": "T"}, celsius
    if target in rig.velocities:
        position = rig.position_of.get(target)
        return (
            "velocity_node",
            {"target": "v"},
            {target: name("v"), **({position: name("x")} if position else {})},
        )
    return "node", {"target": "n"}, {target: name("n")}


def save_effect(result: Mapping[str, Any], label: str, folder: Path) -> list[Path]:
    """Write the laws of a diagnosis as effect files, and return their paths. Raises InputError.

    The first has this name, the next one the same with _2."""
    laws = every_law(result)
    if not laws:
        raise InputError(
            "this diagnosis has no law to save; one with `remainder.law` in diagnosis.json was expected"
        )
    if not label.isidentifier():
        raise InputError(f"'{label}': a name of letters, digits and _ was expected, such as windage")
    for law in laws:
        if not law["effect"]:
            raise InputError(
                f"the law acts at {law['where']} of this plant alone; a law in one flow or storage was expected"
            )
    make_folder(folder)
    names = [label, *(f"{label}_{k}" for k in range(2, len(laws) + 1))]
    paths = [folder / f"{own}.yaml" for own in names]
    for path in paths:
        if path.exists():
            raise InputError(f"{path}: exists already; another name or folder (--effects) was expected")
    for law, own, path in zip(laws, names, paths, strict=True):
        effect = {**law["effect"], "effect": own}
        write_text(path, yaml.safe_dump(effect, sort_keys=False, allow_unicode=True))
    return paths
