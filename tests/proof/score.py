"""Score one diagnosis against its sealed answer: detection, name, place, and the gain of the added effect.

Held-out gain: with e the mean over outputs of (rms / oracle's rms)^2 on held-out data,

    share = (e_refit - e_after) / (e_refit - 1)

1: as good as the true physics. 0: no better than a refit alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from thermoctl.files.yamlfile import InputError

SYMMETRIC = ("missing_link", "bending")  # `a-b` and `b-a` name the same place
NAMING = ("explained", "partly_explained", "ambiguous")  # verdicts that state a name
CONFIDENT = 0.9  # a name given with at least this probability counts as stated with confidence
WORTH_FINDING = 1.02  # (rms of a refit / oracle's rms)^2 from which a gain is measured: 1 % of rms
FAILED: Mapping[str, Any] = {"verdict": "failed", "findings": [], "alternatives": [], "fit": {}}

Named = tuple[str, str]  # an effect and its place

# Small misfits of the open world (tests/concealed/open_world.py) that are entries of the catalogue, too
MISFITS = {
    "slow reference": "sensor_lag",
    "stem": "sensor_gain",
    "contacts": "temperature_dependent_conductance",
    "finite bodies": "hidden_thermal_mass",
}


@dataclass
class Row:
    """One scored case.

    `called` is the diagnosis in one word: an effect, `none` or `unknown`.
    """

    case: str
    family: str
    kind: str
    band: str | None
    size: float | None  # part of the effect that a refit cannot absorb, in sigmas of an ideal single test
    learnt: float | None  # the same for a test that has to learn the noise from the same record
    colour: str | None  # of the noise
    truth: list[Named]
    verdict: str
    called: str
    findings: list[Named]
    detected: bool
    named: bool
    exact: bool  # the findings are exactly the true effects by name
    alike: bool  # the same, counting an equivalent name as the true one
    placed: bool | None  # every correctly named finding is at the right place; None without one
    inside: bool | None  # every true effect (or an equivalent) is among findings and alternatives
    inside_exact: bool | None
    set_size: int
    confident: bool
    onset_error: float | None  # share of the recording's length
    gain: float | None
    cpu_s: float | None
    error: str | None
    world: str = "closed"  # open: with small misfits of no known name
    strays: int = 0  # findings that are not there, and not equivalent to what is there
    of_misfits: int = 0  # findings that are a small misfit of the open world itself
    calibration: list[tuple[float, bool]] = field(default_factory=list)
    parameters: list[dict[str, Any]] = field(default_factory=list)


def same_place(effect: str, a: str, b: str) -> bool:
    """Check whether two places of an effect are the same.

    A symmetric one may name its two ends in either order."""
    return a == b or (effect in SYMMETRIC and "-" in a and a.split("-") == b.split("-")[::-1])


@dataclass(frozen=True)
class Truth:
    """The true effects of a case, and the effects that the data cannot distinguish from them."""

    effects: list[Named]
    kind: str  # none, one, pair, cancel, unknown
    equivalent_names: frozenset[str]
    equivalent_places: list[Named]
    also_right: list[Named]
    misfits: list[Named]  # names of the small misfits that the catalogue has; place "all": anywhere

    @classmethod
    def of(cls, case: str, answer: Mapping[str, Any]) -> Truth:
        """Read the truth from an answer. Raises InputError if a key is missing."""
        for key in ("verdict", "effects", "nearly_the_same"):
            if key not in answer:
                raise InputError(
                    f"answer of case {case}: `{key}` is missing; expected verdict, effects and nearly_the_same"
                )
        effects = [(str(e), str(w)) for e, w in answer["effects"]]
        return cls(
            effects,
            answer.get("kind") or _kind(effects),
            frozenset(answer["nearly_the_same"]),
            [(e, w) for e, w in answer.get("nearly_the_same_places", [])],
            [(e, w) for e, w in answer.get("also_right", [])],
            [(MISFITS[m], w) for m, w in answer.get("misfits", []) if m in MISFITS],
        )

    def names(self, found: Named, true: Named) -> bool:
        """Check whether a finding names this true effect, or one equivalent to it."""
        return found[0] == true[0] or found[0] in self.equivalent_names or found in self.equivalent_places

    def named_by(self, found: Named) -> bool:
        """Check whether a finding names any true effect."""
        return any(self.names(found, t) for t in self.effects)

    def of_misfit(self, found: Named) -> bool:
        """Check whether a finding is a small misfit of the open world, which is there, too."""
        return any(found[0] == e and w in (found[1], "all") for e, w in self.misfits)

    def at(self, found: Named) -> bool:
        """Check whether a finding is at the place of a true effect, or at one equivalent to it."""
        effect, place = found
        return (
            any(same_place(effect, place, w) for _, w in self.effects)
            or found in self.equivalent_places
            or found in self.also_right
            or any(same_place(e, place, w) and e == effect for e, w in self.equivalent_places)
        )

    def nearest(self, finding: Mapping[str, Any]) -> Named:
        """Return what a finding names; of a family the member that is nearest to the truth."""
        return max(
            meant(finding),
            key=lambda n: (self.named_by(n) and self.at(n), self.named_by(n), self.of_misfit(n)),
        )

    def holds(self, found: Named) -> bool:
        """Check whether effect and place are exactly true; equivalents do not count."""
        effect, place = found
        right = any(effect == e and same_place(e, place, w) for e, w in self.effects)
        return right or found in self.also_right or self.of_misfit(found)


def meant(finding: Mapping[str, Any]) -> list[Named]:
    """Return what a finding names: its effect, or the members of its family."""
    return [(m["effect"], m["where"]) for m in finding.get("members", [finding])]


def _kind(effects: Sequence[Named]) -> str:
    if not effects:
        return "none"
    if effects[0][0] == "?":
        return "unknown"
    return "one" if len(effects) == 1 else "pair"


def score(
    case: str,
    answer: Mapping[str, Any],
    result: Mapping[str, Any] | None,
    cpu_s: float | None = None,
    error: str | None = None,
    duration_s: float | None = None,
) -> Row:
    """Compare one diagnosis.json with its answer; None where the diagnosis failed with `error`."""
    truth = Truth.of(case, answer)
    result = result or FAILED
    verdict = result["verdict"]
    findings = [truth.nearest(f) for f in result["findings"]]
    everything = findings + [(f["effect"], f["where"]) for f in result["alternatives"]]
    right_by_name = [f for f in findings if truth.named_by(f)]
    of_misfits = [f for f in findings if f not in right_by_name and truth.of_misfit(f)]
    others = [f for f in findings if f not in of_misfits]
    names = {e for e, _ in everything}
    known = bool(truth.effects) and truth.kind != "unknown"
    return Row(
        case=case,
        family=str(answer.get("family", "")),
        kind=truth.kind,
        band=answer.get("band"),
        size=answer["snr"][0] if truth.kind == "one" and answer.get("snr") else None,
        learnt=answer.get("snr_learnt") if truth.kind == "one" else None,
        colour=answer.get("colour"),
        truth=truth.effects,
        verdict=verdict,
        called=_called(verdict, findings),
        findings=findings,
        detected=verdict not in ("consistent", "failed"),
        named=verdict in NAMING and bool(findings),
        exact=bool(truth.effects) and Counter(e for e, _ in others) == Counter(e for e, _ in truth.effects),
        alike=bool(truth.effects)
        and len(others) == len(truth.effects)
        and _matched(others, truth.effects, truth.names),
        placed=all(map(truth.at, right_by_name)) if right_by_name else None,
        inside=all(any(truth.names(f, t) for f in everything) for t in truth.effects) if known else None,
        inside_exact=all(t[0] in names for t in truth.effects) if known else None,
        set_size=len(names),
        confident=any(float(f["probability"]) >= CONFIDENT for f in result["findings"]),
        onset_error=_onset(answer.get("onset"), result["findings"], duration_s),
        gain=_gain(result.get("fit", {}), answer.get("oracle_rms")),
        cpu_s=cpu_s,
        error=error,
        world=str(answer.get("world", "closed")),
        strays=len(others) - len(right_by_name),
        of_misfits=len(of_misfits),
        calibration=[
            (float(f["probability"]), any(map(truth.holds, meant(f))))
            for f in [*result["findings"], *result["alternatives"]]
        ],
        parameters=_parameters(truth.effects, answer.get("parameters", []), result["findings"]),
    )


def _called(verdict: str, findings: Sequence[Named]) -> str:
    if verdict == "failed":
        return "failed"
    if verdict == "consistent":
        return "none"
    return findings[0][0] if findings and verdict != "unexplained" else "unknown"


def _matched(
    findings: Sequence[Named], truth: Sequence[Named], names: Callable[[Named, Named], bool]
) -> bool:
    """Check whether few findings can be matched to few truths one to one."""
    if not findings:
        return True
    return any(
        names(findings[0], t) and _matched(findings[1:], [*truth[:i], *truth[i + 1 :]], names)
        for i, t in enumerate(truth)
    )


def _onset(
    true: float | None, findings: Sequence[Mapping[str, Any]], duration_s: float | None
) -> float | None:
    starts = [f["when"][0][0] for f in findings if f.get("when")]
    if true is None or not starts or not duration_s:
        return None
    return min(abs(s - true) for s in starts) / duration_s


def _gain(fit: Mapping[str, Any], oracle: Mapping[str, float] | None) -> float | None:
    """Compute the share of the oracle's held-out gain.

    None where a refit alone is within 1 % of the oracle."""
    before, after = fit.get("held_out_refit_only") or {}, fit.get("held_out_after") or {}
    outputs = [o for o in (oracle or {}) if before.get(o) is not None and after.get(o) is not None]
    if not outputs or oracle is None:
        return None
    e_before = sum((before[o] / oracle[o]) ** 2 for o in outputs) / len(outputs)
    e_after = sum((after[o] / oracle[o]) ** 2 for o in outputs) / len(outputs)
    return (e_before - e_after) / (e_before - 1) if e_before > WORTH_FINDING else None


def _parameters(
    truth: Sequence[tuple[str, str]],
    true: Sequence[Mapping[str, float]],
    findings: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Compare the parameters of right findings: error, coverage (`A_1` is `A`), whether they are names."""
    rows = []
    for (effect, place), values in zip(truth, true, strict=False):
        right = (f for f in findings if f["effect"] == effect and same_place(effect, f["where"], place))
        found = next(right, None)
        if found is None:
            continue
        for name, value in values.items():
            estimate = next(
                (p for n, p in found["parameters"].items() if n == name or n.startswith(f"{name}_")), None
            )
            if estimate is not None and value:
                wide = 1.96 * (estimate["sd"] or 0.0)
                rows.append(
                    {
                        "effect": effect,
                        "parameter": name,
                        "error": abs(estimate["value"] / value - 1),
                        "covered": abs(estimate["value"] - value) <= wide,
                        "named": float(found["probability"]) >= CONFIDENT,
                    }
                )
    return rows


def plain(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows for JSON."""
    return [asdict(r) for r in rows]
