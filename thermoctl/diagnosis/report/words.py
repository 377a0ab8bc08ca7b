"""A diagnosis in a few sentences, by size, from diagnosis.json alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Result = Mapping[str, Any]  # the content of diagnosis.json

WHOLE = 0.99  # share of the misfit's energy, from which a law closes all but the noise

NEXT = {
    "consistent": "Nothing has to be done. Effects that these inputs do not excite would not show: record wider steps to exclude them.",
    "explained": "Use the extended plant. Check it on a recording with another schedule before you trust it outside these ranges.",
    "ambiguous": "Record with inputs on which the candidates differ.",
    "partly_explained": "Use the extended plant for what is named. Look for the rest where and when the remainder is largest.",
    "unexplained": "Look for the cause where and when the remainder is largest. Once it is known, add it to the catalogue "
    "(--effects DIR) and diagnose again.",
}

PERHAPS = "Record more, with wider steps. They show whether it is missing."


def words(found: Result) -> str:
    """Return the findings, their worth, the remainder and the next step."""
    return " ".join([*sentences(found), f"What next: {what_next(found)}"])


def sentences(found: Result) -> list[str]:
    """Return the findings, their worth and the remainder."""
    lines = [_found(found)]
    output = _worst(found)
    if output is None:
        return lines
    if found["findings"]:
        lines.append(_gain(found, output))
    remainder = _remainder(found, output)
    law = law_sentence((found["remainder"] or {}).get("law"))
    return [*lines, *(text for text in (remainder, law) if text)]


def what_next(found: Result) -> str:
    """Return the next step for a person."""
    proposed = found.get("next_experiment")
    if proposed:
        return (
            f"Run the proposed experiment ({proposed['profile']}) and diagnose again with its recording; "
            "`thermoctl diagnose --resolve` does both."
        )
    perhaps = found["verdict"] == "consistent" and found["alternatives"]
    text = PERHAPS if perhaps else NEXT[found["verdict"]]
    if found["truncated"]:
        text += " The budget of refits ended the search: more effects may be hidden."
    return text


def name(finding: Mapping[str, Any]) -> str:
    """Return an effect and its place; with its time, where it is a lag or delay."""
    text = str(finding["effect"]).replace("_", " ")
    parameters = list(finding.get("parameters", {}).values())
    if len(parameters) == 1 and parameters[0]["unit"] == "s":
        text += f" of {parameters[0]['value']:.3g} s"
    if finding.get("when"):
        text += f" from {finding['when'][0][0]:.4g} s"
    return f"{text} at {finding['where']}"


def chance(p: float) -> str:
    """Return a probability in two digits; none is certain."""
    return "above 0.99" if p >= 0.995 else "below 0.01" if p < 0.005 else f"{p:.2f}"


def listed(items: Sequence[str]) -> str:
    """Return `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def difference(unit: str | None) -> str:
    """Return the unit of a difference of readings: kelvins for degrees Celsius."""
    return {"degC": "K", "1": "", None: ""}.get(unit, unit or "")


def amount(found: Result, output: str, value: float | None) -> str:
    """Return an error of an output with its unit."""
    if value is None or not math.isfinite(value):
        return "an unknown amount"
    return f"{value:.3g} {difference(found['outputs'].get(output, {}).get('unit'))}".strip()


def _found(found: Result) -> str:
    names = [f"{name(f)} (probability {chance(f['probability'])})" for f in found["findings"]]
    others = [f"{name(a)} ({chance(a['probability'])})" for a in found["alternatives"][:3]]
    if found["verdict"] == "consistent":
        text = "The recordings agree with the plant within its sensors' noise"
        perhaps = f", and yet something may be missing: {', '.join(others)}."
        return text + (perhaps if others else ": nothing is missing.")
    if found["verdict"] == "ambiguous":
        text = "Something is missing, but these recordings do not name it for sure"
        text += f": most likely {listed(names)}" if names else ""
        return text + (f"; also possible: {', '.join(others)}." if others else ".")
    if names:
        return f"Found: {listed(names)}."
    law = (found["remainder"] or {}).get("law")
    follows = f": it follows {listed(law['of'])} at {law['where']}" if law and law["of"] else ""
    return f"Something is missing that no effect of the catalogue explains{follows}."


def law_sentence(entry: Result | None) -> str:
    """Return the law of the remainder."""
    if not entry:
        return ""
    values = ", ".join(
        f"{n} = {p['value']:.4g} {p['unit'] or ''}".strip() for n, p in entry["parameters"].items()
    )
    values += "".join(f"; {m} is {text}" for m, text in entry.get("memory", {}).items())
    at = f"from {entry['from']} into {entry['into']}" if entry["from"] else f"into {entry['into']}"
    acts = f"a flow {at}" if entry.get("part", "flow") == "flow" else f"a {entry['part']} of {entry['into']}"
    closes = f"It closes {100 * entry['share_closed']:.0f} % of the misfit's energy"
    if entry["share_closed"] < WHOLE:
        closes += "; a remainder stays"
    return (
        f"A law for it: {acts}, {entry['expression']}, with {values} "
        f"(probability {chance(entry['probability'])}). {closes}."
    )


def _worst(found: Result) -> str | None:
    """Return the output whose error the findings reduce most in its noise; without findings the worst one."""
    fit, noise = found["fit"], {o: x["noise"] for o, x in found["outputs"].items()}

    def size(o: str) -> float:
        """Return the squared error that an output loses, over its noise."""
        refit, after = fit["refit_only"].get(o) or 0.0, fit["after"].get(o) or 0.0
        gain = refit**2 - after**2 if found["findings"] else refit**2
        return float(gain / noise[o] ** 2) if noise[o] else 0.0

    return max(noise, key=size, default=None)


def _gain(found: Result, output: str) -> str:
    fit = found["fit"]

    def of(key: str) -> str:
        """Return an error of the output, with its unit."""
        return amount(found, output, fit[key].get(output))

    text = (
        f"{'They take' if len(found['findings']) > 1 else 'It takes'} the error of {output} from {of('refit_only')} "
        f"after a refit alone ({of('before')} as the plant came) to {of('after')}"
    )
    if str(fit["held_out"]).startswith("recordings"):
        text += f"; on recordings set aside from {of('held_out_refit_only')} to {of('held_out_after')}"
    return text + "."


def _remainder(found: Result, output: str) -> str:
    r = found["remainder"]
    if not r:
        return ""
    output = max(r["over_noise"], key=lambda o: r["over_noise"][o] or 0.0, default=output)
    left = r["rms"].get(output)
    if not left:
        return ""
    text = f"{amount(found, output, left)} of {output} remains that nothing known explains"
    if found["findings"] and r["share_closed"] is not None:
        text += f"; {100 * max(r['share_closed'], 0.0):.0f} % of the misfit's energy is closed"
    text += f"; it enters at {r['node']}" if r["node"] else ""
    return text + (f" and follows {listed(list(r['follows']))}." if r["follows"] else ".")
