"""A diagnosis in a few sentences, from diagnosis.json alone.

The words of a sentence depend on the numbers in it as they are shown, rounded (`figures`)."""

from __future__ import annotations

import re
from collections.abc import Sequence

from thermoctl.diagnosis.report.figures import Output, Result, chance, every_law, outputs, size, with_interval
from thermoctl.diagnosis.verdict import OVERRULED

NEXT = {
    "consistent": "Nothing has to be done. Effects that these inputs do not excite would not show: record wider steps to exclude them.",
    "explained": "Use the extended plant. Check it on a recording with another schedule before you trust it outside these ranges.",
    "ambiguous": "Record with inputs on which the candidates differ.",
    "partly_explained": "Use the extended plant for what is named. Look for the rest where and when the remainder is largest.",
    "unexplained": "Look for the cause where and when the remainder is largest. Once it is known, add it to the catalogue "
    "(--effects DIR) and diagnose again.",
}
WORSE = (
    "Do not predict with the extended plant yet: it misses {} by more than the refitted plant does, on data that took no part. "
    "Record more, with wider steps, and diagnose again."
)
OTHERWISE = (
    "Look for what is different in the recordings set aside, such as a wider range or another load. "
    "Add one of them to those of the fit, and diagnose again."
)
PERHAPS = "Record more, with wider steps. They show whether it is missing."
SMALL = "Errors of this size matter only where finer readings would, too. Longer recordings show more of their cause."
LIKELY = 0.05  # least probability that something is missing, or an effect, that is worth a word
RATHER = 0.5  # least probability of an alternative that is mentioned where nothing is named
# Least held-out error, extended over refitted, that speaks against the extended plant. Of 306 outputs of 100
# diagnoses with findings the largest was 1.07.
CLEARLY = 1.5
LARGER = 1.1  # least error over the noise that is stated with the verdict `consistent`
FEW = 2  # largest number of intervals of time that are listed
NOT_RANDOM = 0.5  # least probability of a remainder, smaller than the noise, that is mentioned


def words(result: Result) -> str:
    """Return the findings, their worth, the remainder and the next step."""
    return " ".join([*sentences(result), f"What next: {what_next(result)}"])


def sentences(result: Result) -> list[str]:
    """Return the findings, their worth and the remainder."""
    rows = outputs(result)
    every = every_law(result)
    laws = [law_sentence(law, f"The law at {law['where']}" if every[1:] else "A law for it") for law in every]
    texts = [_found(result, rows), *_families(result), *laws]
    if rows and (result["findings"] or laws):
        texts.append(_gain(result, max(rows, key=lambda o: o.gain)))
    return [_places(text, result) for text in (*texts, _remainder(result, rows)) if text]


def _places(text: str, result: Result) -> str:
    """Return a text with words for a node that an effect added, such as strain_backlash_hysteresis_speed."""
    found = {str(e["effect"]) for e in (*result["findings"], *result["alternatives"])}
    for effect in sorted(found, key=len, reverse=True):
        text = re.sub(rf"\b(\w+?)_{effect}_(\w+)", rf"the \1 of the {effect.replace('_', ' ')} at \2", text)
    return text


def what_next(result: Result) -> str:
    """Return the next step for a person."""
    proposed = result.get("next_experiment")
    if proposed and proposed.get("also_helpful"):
        return f"{proposed['also_helpful']} The best experiment of those tried: {proposed['profile']}."
    if proposed:
        return (
            f"Run the proposed experiment ({proposed['profile']}) and diagnose again with its recording; "
            "`thermoctl diagnose --resolve` does both."
        )
    text = NEXT[result["verdict"]]
    if result["decision"].get("row") == OVERRULED:
        text = OTHERWISE
    elif result["verdict"] == "consistent" and _likely(result):
        text = PERHAPS
    elif result["verdict"] in ("unexplained", "partly_explained") and _small(outputs(result)):
        text = f"Use the extended plant. {SMALL}" if result["findings"] else SMALL
    if result["verdict"] in ("explained", "partly_explained") and (worse := _worse(outputs(result))):
        text = WORSE.format(listed(worse))
    if result["truncated"]:
        text += " The budget of refits ended the search: more effects may be hidden."
    return text


def name(finding: Result) -> str:
    """Return an effect and its place as text, with its expression, duration or times if any."""
    text = f"{str(finding['effect']).replace('_', ' ')} {finding.get('expression', '')}".strip()
    parameters = list(finding.get("parameters", {}).values())
    if len(parameters) == 1 and parameters[0]["unit"] == "s":
        text += f" of {parameters[0]['value']:.3g} s"
    if finding.get("when"):
        start, end = finding["when"][0]
        ends = any(p["unit"] == "s" and abs(p["value"] - end) <= 1e-6 * abs(end) for p in parameters)
        run, stays = finding.get("recording"), finding.get("lasts") and not ends
        text += f" in {run}" if run and not stays else ""
        text += (
            f" from {start:.4g} s" + (f" of {run}" if stays else "") + (f" to {end:.4g} s" if ends else " on")
        )
    if finding.get("differs_in"):
        text += f" in {listed(finding['differs_in'])}"
    return f"{text} at {finding['where']}"


def listed(items: Sequence[str]) -> str:
    """Join items as `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


def law_sentence(entry: Result, head: str = "A law for it") -> str:
    """Return a sentence on a law of the remainder, which begins with `head`."""
    values = ", ".join(
        f"{n} = {with_interval(p['value'], p['sd'], p['unit'])} {p['unit'] or ''}".removesuffix(" 1").strip()
        for n, p in entry["parameters"].items()
    )
    values += "".join(f"; {m} is {text}" for m, text in entry.get("memory", {}).items())
    ends = f"from {entry['from']} into {entry['into']}" if entry["from"] else f"into {entry['into']}"
    ends += "".join(f", {share} times it into {node}" for node, share in entry.get("shares", {}).items())
    acts = {
        "flow": f"a flow {ends}",
        "storage": f"a storage of {entry['into']}",
        "parameter": f"a change of the parameter {entry['where']}",
        "reading": f"an error of the reading {entry['where']}",
    }[entry.get("part", "flow")]
    chances = f"that a law acts there has probability {chance(entry['probability'])}; this form fits best"
    short = f", that is {entry['plain']}" if entry.get("plain") else ""
    return f"{head}: {acts}, {entry['expression']}, with {values}{short} ({chances})."


def _likely(result: Result) -> list[Result]:
    return [a for a in result["alternatives"] if a["probability"] >= LIKELY]


def _small(rows: Sequence[Output]) -> bool:
    """Return whether no remainder exceeds its noise or the step of its readings."""
    return bool(rows) and all(o.hidden for o in rows)


def _worse(rows: Sequence[Output]) -> list[str]:
    """Return the outputs that the extended plant predicts clearly worse than the refitted one."""
    errors = ((o.name, o.errors["held_out_refit_only"], o.errors["held_out_after"]) for o in rows)
    return [o for o, alone, extended in errors if alone and extended and extended > CLEARLY * alone]


def _found(result: Result, rows: Sequence[Output]) -> str:
    if result["verdict"] == "consistent":
        over = max((o.over("refit_only") for o in rows), default=1.0)
        text = "The recordings agree with the plant within its sensors' noise"
        text += f" (errors up to {over:.2g} times it)" if over > LARGER else ""
        perhaps = ", ".join(f"{name(a)} ({chance(a['probability'])})" for a in _likely(result)[:3])
        return text + (
            f", and yet something may be missing: {perhaps}." if perhaps else ": nothing is missing."
        )
    if result["verdict"] == "ambiguous":
        every = _single(result)
        candidates = ", ".join(f"{name(a)} ({chance(a['probability'])}{_doubt(a)})" for a in every[:4])
        whole = [f for f in _certain(result) if _members(f) >= {(a["effect"], a["where"]) for a in every}]
        if whole:
            sure = chance(whole[0]["probability"])
            return f"One of these is there (probability {sure}), and these recordings do not tell which: {candidates}."
        text = "Something is missing, but these recordings do not name it for sure"
        return text + (f". Candidates, the likeliest first: {candidates}." if candidates else ".")
    if named := [f for f in result["findings"] if "members" not in f]:
        names = [f"{name(f)} (probability {chance(f['probability'])})" for f in named]
        return f"Found: {listed(names)}."
    if laws := every_law(result):
        return f"Found: {listed([_unknown(law) for law in laws])}, which no effect of the catalogue is."
    why = next((a["why_not"] for a in result["alternatives"] if a.get("why_not")), "")
    doubted = listed([name(a) for a in result["alternatives"] if why and a.get("why_not") == why][:2])
    fits = f" What would fit, though {why}: {doubted}." if doubted else ""
    rather = [a for a in result["alternatives"] if a["probability"] >= RATHER]
    if rather and not doubted:
        told = listed([f"{name(a)} ({chance(a['probability'])})" for a in rather])
        fits = f" Rather likely, but no sure name: {told}."
    if _small(rows):
        what = "A small systematic error stays"
    elif max(result["decision"].get(k, 1.0) for k in ("something", "remains", "flow")) < LIKELY:
        over = result["decision"]["over_noise"]
        return f"The errors are {over:.2g} times the noise: something is missing, or sensors are noisier than stated.{fits}"
    else:
        what = "Something is missing"
    return f"{what}.{fits}" if fits else f"{what} that no effect of the catalogue explains."


def _unknown(law: Result) -> str:
    return f"a law at {law['where']}" + (f" of {listed(law['of'])}" if law["of"] else "")


def _families(result: Result) -> list[str]:
    """Return a sentence for each family of effects that imitate each other, unless `_found` has it."""
    mentioned = {(a["effect"], a["where"]) for a in _single(result)}
    return [
        f"One of these is there (probability {chance(f['probability'])}): {' or '.join(map(name, f['members']))}."
        for f in _certain(result)
        if result["verdict"] != "ambiguous" or not _members(f) >= mentioned
    ]


def _certain(result: Result) -> list[Result]:
    """Return the families of which one effect is certain."""
    return [f for f in (*result["findings"], *result.get("families", ())) if "members" in f]


def _single(result: Result) -> list[Result]:
    """Return findings that are no families, and alternatives, the likeliest first."""
    every = [e for e in (*result["findings"], *result["alternatives"]) if "members" not in e]
    return sorted(every, key=lambda e: -e["probability"])


def _members(family: Result) -> set[tuple[str, str]]:
    return {(e["effect"], e["where"]) for e in family["members"]}


def _doubt(alternative: Result) -> str:
    return f"; {alternative['why_not']}" if alternative.get("why_not") else ""


def _gain(result: Result, o: Output) -> str:
    many = len(result["findings"]) + len(every_law(result)) > 1
    likely = f"With the likeliest{' ones' if many else ''}" if result["verdict"] == "ambiguous" else ""
    came = o.size("before")
    alone = f"{o.size('refit_only')} after a refit alone" + (f" ({came} as the plant came)" if came else "")
    text = f"{likely or ('With them' if many else 'With it')} the error of {o.name} {o.change('refit_only', 'after', alone)}"
    if o.size("held_out_refit_only") and o.size("held_out_after"):
        aside = str(result["fit"]["held_out"]).startswith("recordings")
        where = "on recordings set aside" if aside else "in parts predicted from the others"
        text += f"; {where} it {o.change('held_out_refit_only', 'held_out_after')}"
    return text + "."


def _remainder(result: Result, rows: Sequence[Output]) -> str:
    r = result["remainder"]
    if not r or not rows or result["verdict"] == "explained":
        return ""
    o = max(rows, key=lambda row: row.over_noise or 0.0)
    if result["verdict"] == "ambiguous" and (o.over_noise or 0.0) < LARGER:
        return ""  # a candidate explains it
    noise = size(o.noise, o.unit)
    if o.left:
        text = (
            f"{size(o.left, o.unit)} of {o.name} remains that nothing known explains, beside {noise} of noise"
        )
        text += f" and steps of {size(o.step, o.unit)} in its readings" if o.below_step else ""
    else:
        if result["decision"].get("remains", 0.0) < NOT_RANDOM:
            return ""
        text = f"What remains of {o.name} is no larger than its noise of {noise}, but not random"
    text += f"; it enters at {r['node']}" if r["node"] else ""
    text += f" and follows {listed(list(r['follows']))}" if r["follows"] else ""
    m = next((m for m in result.get("mismatch", ()) if m["channel"] == o.name), None)
    if m and result["verdict"] == "unexplained" and 0 < len(m["when"]) <= FEW:
        times = listed([f"{a:.6g} to {b:.6g} s" for a, b in m["when"]])
        text += f"; most of it is in {m['recording']} from {times}"
    return text + "."
