"""Numbers of a diagnosis, formatted for texts and tables, from diagnosis.json alone.

Report, terminal and `--explain` read their rows here, so that all of them show the same digits."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Result = Mapping[str, Any]  # the content of diagnosis.json
Rows = tuple[tuple[str, ...], Sequence[tuple[str, ...]]]  # heads, rows

NONE = "–"
WIDE = 1.96  # standard deviations to either side of a 95 % interval
ALTERNATIVES = 8  # largest number of alternatives that are listed
SOME = 4  # largest number of recordings whose values are listed
PROMISED = 12  # largest number of effects without a refit that are listed
PLAIN = (1e-3, 1e6)  # values outside this range are written with a power of ten
COLUMNS = {
    "before": "as it came",
    "refit_only": "refitted",
    "after": "extended",
    "held_out_before": "held out: as it came",
    "held_out_refit_only": "held out: refitted",
    "held_out_after": "held out: extended",
}
# Numbers of a decision that are ratios; the others are probabilities.
RATIOS = ("over_noise", "apart")
MEANINGS = {
    "something": "probability that an effect or an unknown law is missing",
    "known": "probability that an effect is missing that other data confirm",
    "over_noise": "largest residual (rms) over its sensor's noise",
    "apart": "largest error (rms) on recordings set aside over its sensor's noise (0 where none was)",
    "worse": "probability that held-out data are predicted worse by the extended plant",
    "remains": "probability that an output still has a systematic error (those that rest on steps of rounding left out)",
    "flow": "probability that an unknown flow is missing which no reading shows alone",
}


@dataclass(frozen=True)
class Output:
    """The numbers of one output, in the unit of its differences. None: not known.

    `errors`: rms errors by the keys of `fit`; `left`: rms of the remainder; `step`: resolution of readings"""

    name: str
    unit: str
    noise: float
    step: float
    errors: Mapping[str, float | None]
    left: float | None
    over_noise: float | None

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name}\u00a0({self.unit})" if self.unit else self.name

    @property
    def gain(self) -> float:
        """Squared error that the extended plant removes, over the squared noise."""
        return self.over("refit_only") ** 2 - self.over("after") ** 2

    def over(self, key: str) -> float:
        """Return an error over the noise."""
        return (self.errors[key] or 0.0) / self.noise if self.noise else 0.0

    @property
    def below_step(self) -> bool:
        """Is the remainder smaller than the steps of the readings?"""
        return (self.left or 0.0) < self.step

    @property
    def hidden(self) -> bool:
        """Is the remainder smaller than the noise, or than the steps of the readings?"""
        return self.left is not None and (self.below_step or self.left <= self.noise)

    def size(self, key: str) -> str:
        """Return an error with its unit; empty where it is not known."""
        return "" if self.errors.get(key) is None else size(self.errors[key], self.unit)

    def change(self, before: str, after: str, first: str = "") -> str:
        """Return how an error changes, by the digits that are shown. `first`: a text for the first error."""
        a, b = self.size(before), self.size(after)
        if a == b:
            return f"stays at {first or a}"
        falls = (self.errors[after] or 0.0) < (self.errors[before] or 0.0)
        return f"{'falls' if falls else 'rises'} from {first or a} to {b or 'an unknown amount'}"


def outputs(result: Result) -> list[Output]:
    """Return the outputs in the plant's order."""
    fit, rest = result["fit"], result["remainder"] or {}
    return [
        Output(
            o,
            {"degC": "K", "1": "", None: ""}.get(x["unit"], x["unit"]),
            x["noise"] or 0.0,
            x.get("step") or 0.0,
            {k: fit.get(k, {}).get(o) for k in COLUMNS},
            rest.get("rms", {}).get(o),
            rest.get("over_noise", {}).get(o),
        )
        for o, x in result["outputs"].items()
    ]


def chance(p: float) -> str:
    """Return a probability in two digits, never 0 or 1."""
    return "above 0.99" if p >= 0.995 else "below 0.01" if p < 0.005 else f"{p:.2f}"


def number(value: float | None) -> str:
    """Return a number in three digits."""
    return NONE if value is None or not math.isfinite(value) else f"{value:.3g}"


def size(value: float | None, unit: str) -> str:
    """Return an error with its unit."""
    return "an unknown amount" if number(value) == NONE else f"{number(value)} {unit}".strip()


def with_interval(value: float, sd: float | None, unit: str | None = None) -> str:
    """Return a value ± half of its 95 % interval, both rounded to two digits of that half.

    An interval of a time, in s, ends at 0: `3 (0 .. 9.2)`."""
    if not sd or not math.isfinite(sd):
        return f"{value:.4g}"
    half = WIDE * sd
    if unit == "s" and 0 <= value < half:
        return f"{value:.2g} (0 .. {value + half:.2g})"
    largest = max(abs(value), half)
    power = 0 if PLAIN[0] <= largest < PLAIN[1] else math.floor(math.log10(largest))
    # a value smaller than its interval keeps two digits of its own
    places = [1 - math.floor(math.log10(min(abs(v) or half, half))) + power for v in (value, half)]
    shown = [
        f"{round(v * 10.0**-power, k):.{max(k, 0)}f}" for v, k in zip((value, half), places, strict=True)
    ]
    return " ± ".join(shown) if not power else f"({' ± '.join(shown)})e{power}"


def short(parameter: str, finding: Result) -> str:
    """Return the name of a finding's parameter without its suffix of effect and place.

    With it, where the equation has another quantity of the short name."""
    place, name = re.sub(r"[^A-Za-z0-9_]", "_", finding["where"]), parameter
    for member in finding.get("members", [finding]):
        name = name.removesuffix(f"_{member['effect']}_{place}")
    return parameter if re.search(rf"\b{name}\b", str(finding.get("equation", ""))) else name


def equation(finding: Result) -> str:
    """Return a finding's equation with the short names of its parameters."""
    text = re.sub(r"\d+\.\d{6,}", lambda m: f"{float(m[0]):.6g}", str(finding["equation"]))
    for n in finding["parameters"]:
        text = text.replace(n, short(n, finding))
    return text


def extends(result: Result) -> bool:
    """Return whether the result's plant has an effect or a law more than the original one."""
    return bool(result["findings"] or every_law(result))


def every_law(result: Result) -> list[Result]:
    """Return the law of the remainder and those beside it."""
    law = (result.get("remainder") or {}).get("law")
    return [law, *law.get("beside", ())] if law else []


def error_rows(result: Result) -> Rows:
    """Return the rms errors by output."""
    keys = [k for k in COLUMNS if extends(result) or not k.endswith("after")]
    keys = [k for k in keys if any(o.errors[k] is not None for o in outputs(result))]
    rows = [(o.label, number(o.noise), *(number(o.errors[k]) for k in keys)) for o in outputs(result)]
    return ("rms error of", "noise", *(COLUMNS[k] for k in keys)), rows


def fit_rows(result: Result) -> Rows:
    """Return the fit of each recording in percent, those held out first."""
    entries = result.get("recordings", ())
    keys = [k for k in COLUMNS if any(k in e["fit_percent"] for e in entries)]
    rows = [
        (
            f"{e['recording']}: {e['output']}" + (", held out" if e["held_out"] else ""),
            *(percent(e["fit_percent"].get(k)) for k in keys),
        )
        for e in entries
    ]
    return ("fit in % of", *(COLUMNS[k] for k in keys)), rows


def percent(value: float | None) -> str:
    """Return a fit in percent with one decimal."""
    return NONE if value is None else f"{value:.1f}"


def remainder_rows(result: Result) -> Rows:
    """Return each output's error beyond its noise."""
    rows = [
        (
            o.label,
            number(o.noise),
            number(o.step) if o.step else NONE,
            number(o.left) if o.left else NONE,
            number(o.over_noise),
        )
        for o in outputs(result)
    ]
    return (
        "output",
        "noise",
        "step of readings",
        "error beyond the noise",
        "whole error over the noise",
    ), rows


def parameter_rows(finding: Result) -> Rows:
    """Return the parameters of a finding or a law."""
    rows = [
        (
            short(n, finding) if "effect" in finding else n,
            _between(p) if p.get("values") else with_interval(p["value"], p["sd"], p["unit"]),
            p["unit"] or "",
        )
        for n, p in finding["parameters"].items()
    ]
    return ("parameter", "value, 95 %", "unit"), rows


def _between(parameter: Mapping[str, Any]) -> str:
    """Return the values of a parameter by recording; of more than SOME the least and the largest one."""
    if len(parameter["values"]) <= SOME:
        return ", ".join(
            f"{with_interval(v, parameter['sd'])} in {r}" for r, v in parameter["values"].items() if v
        )
    ends = sorted({min(parameter["values"].values()), max(parameter["values"].values())})
    return " .. ".join(with_interval(v, parameter["sd"]) for v in ends)


def alternative_rows(result: Result) -> Rows:
    """Return the alternatives, the likeliest first, each with the reason why it is not named."""
    rows = [
        (
            f"{_plain(a['effect'])} {a.get('expression', '')}".strip(),
            a["where"],
            chance(a["probability"]),
            a.get("why_not", ""),
        )
        for a in result["alternatives"][:ALTERNATIVES]
    ]
    return ("alternative", "where", "probability", "but"), rows


def decision_rows(result: Result) -> Rows:
    """Return the numbers that decided, in words."""
    numbers = {k: v for k, v in result["decision"].items() if k != "row" and v is not None}
    return ("number", "value"), [
        (MEANINGS.get(k, f"probability of {_plain(k)}"), (number if k in RATIOS else chance)(v))
        for k, v in numbers.items()
    ]


def hypothesis_rows(result: Result) -> Rows:
    """Return every hypothesis that was fitted."""
    heads = ("hypothesis", "log evidence", "log prior odds", "probability", "stands out", "remainder")
    return heads, [
        (
            " + ".join(h["effects"]).replace("_", " ") or "no effect",
            f"{h['log_evidence']:.1f}",
            f"{h['log_prior_odds']:.1f}",
            chance(h["posterior"]),
            NONE
            if not h["effects"]
            else "no"
            if h["physics"] is None
            else ", ".join(map(chance, h["physics"])),
            chance(h["remainder"]),
        )
        for h in result["hypotheses"]
    ]


def lost_rows(result: Result) -> Rows:
    """Return the effects that were tried and are no finding, and why, the closest first."""
    rows = [
        (
            _plain(f"{e['effect']} at {e['where']}"),
            e["reason"] + (f"; best beside {' + '.join(map(_plain, e['beside']))}" if e["beside"] else ""),
            chance(e["probability"]),
            below(e["below_best"]),
        )
        for e in result["lost"]
    ]
    rows += [(_plain(" + ".join(r["effects"])), r["reason"], NONE, NONE) for r in result["refused"]]
    tried = {f"{e['effect']} at {e['where']}" for e in (*result["lost"], *result["findings"])}
    tried |= {n for r in result["refused"] for n in r["effects"]}
    promised = sorted(((g, n) for n, g in result["promised"].items() if n not in tried), reverse=True)
    rows += [
        (_plain(n), f"not fitted: to first order it gains at most {g:.1f} nats", NONE, NONE)
        for g, n in promised[:PROMISED]
    ]
    return ("effect", "why it is no finding", "probability", "log odds"), rows


def below(nats: float) -> str:
    """Return by how many nats a hypothesis is below or above the result."""
    return f"{abs(nats):.1f} {'below' if nats >= 0 else 'above'} the result"


def _plain(text: str) -> str:
    return text.replace("_", " ")


def merged(notes: Sequence[str]) -> list[str]:
    """Return each note once, with the number of its repetitions."""
    return [
        note + (f" ({notes.count(note)} times)" if notes.count(note) > 1 else "")
        for note in dict.fromkeys(notes)
    ]
