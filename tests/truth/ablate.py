"""What each rule on the way to a name is worth: the cases of `make truth`, decided without it.

    python -m tests.truth.ablate [--number 60] [--only home,foreign,closed,open,crowded] [--search] [RULE...]

RULES is the list of all rules that decide. A rule of the decision is left out of the searches that
`make truth` kept, in a minute; one of the search (--search) needs new searches. Prints, for each rule and
group, right names, strays and the log score with it and without it, and the cases that change.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.truth import dozen
from tests.truth.__main__ import GROUPS, cases, options, write
from tests.truth.judge import Row, changes, figures, row
from tests.truth.run import KEPT, kept, sought
from thermoctl.diagnosis import diagnose as engine
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.threads import one_thread
from thermoctl.diagnosis.verdict.unknown_flow import Missing
from thermoctl.fleet.jobs import Job, outcome


@dataclass(frozen=True)
class Rule:
    """A rule, where it stands, and how to leave it out.

    - `without`: name of the program (below thermoctl.diagnosis) to what takes its place
    - `limits`: numbers of config/diagnosis.yaml in place of theirs
    - `weighed`: changes the evidence of what the search found
    - `searches`: it acts in the search, else in the decision"""

    says: str
    without: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Any] = field(default_factory=dict)
    weighed: Callable[[engine.Sought], engine.Sought] = lambda found: found
    searches: bool = False


def _keeps(posterior: Any, found: Any, *rest: Any) -> Any:
    return found, posterior, {}


def _ours(case: Any, f: Any) -> Any:
    return f


def _first(likeliest: Any, physics: Any) -> Any:
    return likeliest


def _nothing(*a: Any) -> Any:
    return ()


def _none(*a: Any) -> list[Any]:
    return []


def _no(*a: Any) -> bool:
    return False


def _sure(*a: Any) -> float:
    return 1.0


def _all(error: Any) -> float:
    return float(len(error))


def _stated(case: Any, f: Any) -> list[float]:
    return [float(g.variance) ** 0.5 for g in case.grids]


def _fine(case: Any) -> list[bool]:
    return [False] * len(case.grids)


RULES: Mapping[str, Rule] = {
    "misfit": Rule("an effect counts only where it stands out of the misfit that stays", {"verdict.misfit.physics": _sure}),
    "dozen": Rule(
        "an effect counts only where it stands out; in its place, a misfit's rows count as a few draws (dozen.py)",
        {"verdict.misfit.physics": _sure},
        weighed=dozen.weighed,
    ),
    "simpler": Rule("an entry that contains a simpler one has to stand out against it", {"verdict.misfit._is_simpler": _no}),
    "weakest": Rule("of effects that do not stand out the weakest leaves first", {"diagnose.supported": _first}),
    "clean": Rule("a residual up to 1.25 of its noise is no misfit", limits={"clean": 1.0}),
    "coarse": Rule(
        "a reading that rests on its steps has no certain remainder",
        {"verdict.misfit.rounded": _fine, "evidence.levels.rounded": _fine},
    ),
    "better refit": Rule(
        "of the two refits of a hypothesis the better one counts",
        {"verdict.misfit.as_refitted": _ours, "verdict.confirm.as_refitted": _ours},
    ),
    "confirmed": Rule("a name has to predict parts that it was not fitted to", {"diagnose.confirmed": _keeps}),
    "event": Rule("beside a misfit an event needs another recording", {"verdict.confirm.timed": _no, "diagnose.timed": _no}),
    "only noise": Rule("where only noise is left, nothing is asked of other parts", {"diagnose.only_noise": _no}),
    "unasked": Rule("where nothing is asked of other parts, the log evidence counts less", limits={"unasked": 1.0}),
    **{
        f"unasked {d:g}": Rule(
            f"there it is divided by `unasked`; by {d:g} in its place", limits={"unasked": d}
        )
        for d in (2.0, 3.0)
    },
    "floor": Rule("an error far below the noise is luck", {"verdict.confirm.FLOOR": 1e-6}),
    "draws": Rule("a smooth error counts as few draws", {"verdict.confirm._draws": _all}),
    "learnt noise": Rule(
        "a stated noise may be wrong by two standard deviations of its prior",
        {"evidence.levels.levels": _stated},
    ),
    "coloured": Rule("a certain remainder may be the coloured noise of a sensor", {"diagnose.coloured": lambda case, f: []}),
    "unknown flow": Rule(
        "an unknown flow is one more hypothesis where nothing else is certain",
        {"diagnose.flow_missing": lambda *a: Missing()},
    ),
    "between": Rule(
        "inputs go on in straight lines where the plant alone follows the recordings better so",
        {"diagnose.between": lambda plant, made: made(plant)},
        searches=True,
    ),
    "levels": Rule(
        "an input whose reading scatters about levels drives the plant by them where it fits better so",
        {"diagnose.steady": lambda case, made, tables, reserve: (case, [*reserve], {})},
        searches=True,
    ),
    "place of a flow": Rule(
        "a law may take the place of a flow whose factor is held at its lower bound",
        {"law.refit._with_room": lambda f, laws: None},
        searches=True,
    ),
    "energy": Rule(
        "where the error is twice the noise, effects are proposed by their gain in energy, too",
        {"search.screening.LOUD": float("inf")},
        searches=True,
    ),
    "pairs": Rule(
        "two effects that explain far more together than alone are refitted together",
        {"search.shortlist.pairs": _none},
        searches=True,
    ),
    "swap": Rule(
        "each effect of the best meets rivals in its place, and itself at other places",
        {"search.beam.swap": _nothing, "search.beam.elsewhere": _none},
        searches=True,
    ),
    "mistakes": Rule("wrong numbers of the plant file are rivals", {"search.beam.mistakes": _nothing}, searches=True),
    "undone": Rule(
        "an effect that undoes the lag of an input has the odds `rare` once more",
        {"evidence.odds._undone": _no},
        searches=True,
    ),
    "file's values": Rule(
        "parts of the best that are far from the plant file's values are extended from these, too",
        {"search.beam.afresh": lambda s: None},
        searches=True,
    ),
    "law's values": Rule(
        "what stands beside a leading law is extended from the law's refit",
        {"law.contest._as_known": lambda s: None},
        searches=True,
    ),
    "observer": Rule("a rig that drifts is searched with an observer, too", {"search.beam.with_observer": _no}, searches=True),
    "near nothing": Rule(
        "an effect of no size is left out where the others fit as well from its values",
        {"search.beam.cleared": _none},
        searches=True,
    ),
    "its size": Rule(
        "a law that leads the hypotheses of its size is extended, though larger ones are ahead",
        {"law.contest._leading": lambda s, size: s.best},
        searches=True,
    ),
    "more terms": Rule(
        "one more term of a law competes with each effect beside it",
        {"law.contest._more": _nothing},
        searches=True,
    ),
    "rarer": Rule(
        "a law has the odds `rare` once more where an effect at its nodes was tried in its place",
        {"law.contest._make_rarer": lambda s, which: None},
        searches=True,
    ),
    "answers": Rule(
        "more outliers right after switches than by chance are answers of the plant",
        {"data.outliers._without_answers": lambda odd, after: odd},
        searches=True,
    ),
    "near": Rule(
        "4.6 nats below a best that leaves only noise nothing is extended",
        {"search.beam.NEAR": float("inf")},
        searches=True,
    ),
    "reading": Rule(
        "a law depends on no unread column that follows a node or an output",
        {"law.signals._follows": _no},
        searches=True,
    ),
    "half": Rule("a promise may be doubled", {"search.beam.HALF": 1.0}, searches=True),
    "pays": Rule(
        "beside one effect that leaves only noise, laws compete only where a free function pays for one",
        {"law.contest.pays": lambda case, f, limits: True},
        searches=True,
    ),
    "laws": Rule("laws compete", {"diagnose.with_laws": lambda s: s}, searches=True),
}  # fmt: skip


def part_of(path: str) -> Any:
    """Return a name of the program, below thermoctl.diagnosis."""
    module, attribute = path.rsplit(".", 1)
    return getattr(importlib.import_module(f"thermoctl.diagnosis.{module}"), attribute)


@contextmanager
def left_out(rule: Rule) -> Iterator[None]:
    """Leave a rule out of the program of this process."""
    held = {path: part_of(path) for path in rule.without}
    try:
        for path, other in rule.without.items():
            _put(path, other)
        yield
    finally:
        for path, value in held.items():
            _put(path, value)


def _put(path: str, value: Any) -> None:
    module, attribute = path.rsplit(".", 1)
    setattr(importlib.import_module(f"thermoctl.diagnosis.{module}"), attribute, value)


def without(name: str, job: Job, folder: Path) -> tuple[dict[str, Any] | None, str | None]:
    """Return the result of one case that is decided without a rule ("": with all), or what failed."""
    rule = RULES.get(name, Rule(""))
    numbers = dataclasses.replace(limits(), **rule.limits)
    with one_thread(), left_out(rule):
        try:
            found = sought(job, numbers) if rule.searches else kept(folder / job.name)
            changed = rule.weighed(found)
            changed = dataclasses.replace(changed, case=dataclasses.replace(changed.case, limits=numbers))
            return contract(engine.decided(changed)), None
        except Exception as e:  # a crash is a result
            return None, f"{type(e).__name__}: {e}"


def line(what: str, rows: Mapping[str, Row]) -> str:
    """Return right names, strays and log score of each group as a row of Markdown."""
    cells = []
    for group in GROUPS:
        of = [r for r in rows.values() if r["group"] == group]
        if of:
            f = figures(of)
            cells.append(f"{f['right names'].split(' ')[0]}, {f['strays at 0.9']}, {f['log score']}")
    return f"| {what} | {' | '.join(cells)} |"


def main(argv: Sequence[str] | None = None) -> int:
    """The command."""
    p = argparse.ArgumentParser(prog="python -m tests.truth.ablate", description=__doc__.splitlines()[0])
    p.add_argument("rules", nargs="*", metavar="RULE", help="default: all of the decision")
    options(p)
    p.add_argument(
        "--search", action="store_true", help="the rules of the search: each case is searched again"
    )
    p.add_argument(
        "--keep", type=Path, metavar="FILE", help="write the result with all rules, for OLD= of make truth"
    )
    a = p.parse_args(argv)
    folder = a.out / "diagnoses"
    found = [c for c in cases(a) if (folder / c.job.name / KEPT).exists()]
    if not found:
        print("no kept search: run make truth first", file=sys.stderr)
        return 2
    costs = {c.job.name: float(outcome(c.job, folder)[1].get("cpu_s") or 0.0) for c in found}
    groups = [title for g, title in GROUPS.items() if any(c.group == g for c in found)]
    print(f"| without | {' | '.join(groups)} |\n{'|---' * (len(groups) + 1)}|", flush=True)
    judged: dict[str, dict[str, Row]] = {}
    with ProcessPoolExecutor(a.workers) as pool:
        for name in ("", *(a.rules or [n for n, r in RULES.items() if r.searches == a.search])):
            results = pool.map(without, [name] * len(found), [c.job for c in found], [folder] * len(found))
            judged[name] = {
                c.job.name: row(c, result, costs[c.job.name], error)
                for c, (result, error) in zip(found, results, strict=True)
            }
            print(line(name or "nothing: all rules", judged[name]), flush=True)
    base = judged.pop("")
    if a.keep:
        write(base, a.keep)
    changed = {name: changes(base, rows) for name, rows in judged.items()}
    for name, of in changed.items():
        print(f"\n{name}: {RULES[name].says}")
        print("\n".join(f"- {case}: *{kind}* {what}" for case, kind, what in of if kind != "verdict"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
