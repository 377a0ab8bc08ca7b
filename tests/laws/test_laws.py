"""A concealed law is found, written and found again by name; where nothing is missing, none is claimed."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp

from tests.laws.prove import EQUAL, cases, difference
from tests.laws.real import law_of
from tests.laws.rigs import LAWS, RELAYS, STORAGES, TANKS, make
from tests.plants import SPRING_STAGE, TWO_BLOCKS
from tests.proof.rigs import RIGS
from thermoctl.cli import main
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose, sought
from thermoctl.diagnosis.evidence.fit import Placed, fitted
from thermoctl.diagnosis.evidence.levels import only_noise
from thermoctl.diagnosis.evidence.odds import odds
from thermoctl.diagnosis.experiment.propose import propose, survivors
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.law.forms import Term, families, library
from thermoctl.diagnosis.law.propose import PROPOSALS, Proposal, propose_laws
from thermoctl.diagnosis.law.refit import (
    FEWEST_REFITS,
    SIMPLER,
    affordable,
    law_candidate,
    law_rate,
    laws_of,
    refitted_law,
)
from thermoctl.diagnosis.law.result import law_entry, law_section, save_effect, wrong_ends
from thermoctl.diagnosis.law.signals import Place, Signal, conversions, places, signals
from thermoctl.diagnosis.law.smooth import Tracked, _explained, tracked
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report.words import law_sentence
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant import load, loads, save
from thermoctl.plant.language import Flow, Input, Node, Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

FOLDER = Path(os.environ.get("THERMOCTL_RECORDINGS", Path(__file__).parents[3] / "shared/recordings"))
ENTROPIC = next(law for law in LAWS if law.name == "entropic heat")


def look(made, reserve=slice(2, 3)):
    """The diagnosis without the catalogue, and its law."""
    d = diagnose(made.plant, made.tables[:2], {}, limits(), made.tables[reserve])
    return d, d.law


@pytest.fixture(scope="module")
def found():
    made = make(ENTROPIC, "reactor", "middle", "closed", 7)
    return made, *look(made)


def test_a_law_has_its_place_its_variable_and_the_flow_of_the_truth(found):
    made, _, law = found
    assert law is not None
    assert law.proposal.place.where == "broth"
    assert {s.label for t in law.proposal.terms for s in t.signals} == {"current"}
    assert difference(law.fitted.plant, made) < EQUAL
    assert law.confirmed > 0.9 and found[1].worth.share_closed > 0.9


def test_the_entry_holds_units_and_the_report_draws_the_curve(found):
    _, d, law = found
    entry = json.loads(json.dumps(law_entry([law], d.worth)))
    assert entry["into"] == "broth" and entry["parameters"]["A1"]["unit"] == "W"
    page = law_section([law], {"remainder": {"law": entry}})
    assert "<svg" in page and "95 %" in page


def test_the_extended_plant_is_a_plant_file(found, tmp_path):
    _, _, law = found
    save(law.fitted.plant, tmp_path / "plant.yaml", note="with a law")
    assert load(tmp_path / "plant.yaml").flows.keys() == law.fitted.plant.flows.keys()


def test_a_saved_law_is_an_effect_that_finds_its_place(found, tmp_path, capsys):
    made, d, law = found
    known = d.case
    result = {
        "decision": {},
        "hypotheses": [],
        "lost": [],
        "refused": [],
        "promised": {},
        "remainder": {"law": law_entry([law], d.worth)},
    }
    (tmp_path / "diagnosis.json").write_text(json.dumps(result))
    own = tmp_path / "own"
    assert main(["effects", "save", str(tmp_path), "peltier", "--effects", str(own)]) == 0
    assert yaml.safe_load((own / "peltier.yaml").read_text())["effect"] == "peltier"
    rig = known.rig(made.plant, known.drives(known.null.model))
    entries = catalogue([own])
    assert [c.key for c in candidates(rig, entries)] == [("peltier", "broth")]
    save(made.plant, tmp_path / "plant.yaml")
    assert main(["effects", "check", str(own), "--plant", str(tmp_path / "plant.yaml")]) == 0
    assert main(["effects", "save", str(tmp_path), "peltier", "--effects", str(own)]) != 0
    assert "exists already" in capsys.readouterr().err


def test_a_law_keeps_its_prior_odds_beside_effects(found):
    """It had the odds of an entry of the catalogue there, so that any effect beside a law gained some ten nats."""
    _, d, law = found
    known, leader = d.case, d.searched.tried[0]
    rig = known.rig(known.plant, known.drives(known.null.model))
    other = Placed(candidates(rig, catalogue())[0], {})
    places = {other.key[0]: {other.key[1]}}
    alone, beside = (odds((*effects, other), places, limits()) for effects in ((), (law.placed,)))
    assert beside - alone == pytest.approx(leader.log_odds) == pytest.approx(-law.proposal.cost)


def test_a_larger_plant_gets_fewer_refits_of_laws(found):
    _, d, law = found
    once = affordable(d.case, law.fitted)
    often = affordable(replace(d.case, tables=d.case.tables * 2000), law.fitted)
    assert once == 2 * PROPOSALS + SIMPLER and often == FEWEST_REFITS


def test_without_a_reserve_parts_that_were_left_out_confirm_the_law(found):
    made, _, _ = found
    d, law = look(made, slice(0))
    assert law is not None and law.confirmed > 0.9
    assert difference(law.fitted.plant, made) < EQUAL
    assert not d.worth.reserved


def test_an_experiment_separates_laws_that_fit_about_as_well(found):
    _, d, law = found
    known = d.case
    parent = fitted(known, known.plant, (), known.null)
    (term,) = law.proposal.terms
    forms = {f.name: f for f in library()}
    bent = replace(term, form=forms["saturation"], shapes={"s": 2.5})
    other = replace(law.proposal, terms=(bent,), sizes=(3.5 * law.proposal.sizes[0],))
    rival = refitted_law(known, parent, other, parent)
    both = replace(law, placed=replace(law.placed, rivals=((other, rival, 0.4),)))
    undecided = SimpleNamespace(case=known, decision=SimpleNamespace(verdict="partly_explained"), law=both)
    assert [share for _, share, _ in survivors(undecided)] == pytest.approx([0.6, 0.4])
    entry, _ = propose(undecided)
    assert "current" in entry["inputs"]
    law_with_numbers = r"\(?[-\d.e]+\)? \* \(current / ([\d.]+)\) / \(abs\(current / \1\) \+ [\d.]+\)"
    assert re.match(law_with_numbers, entry["separates"][0]["hypothesis"])
    undecided.law = replace(law, placed=replace(law.placed, rivals=()))
    assert propose(undecided) is None
    itself = ((law.proposal, law.fitted, 0.4),)
    undecided.law = replace(law, placed=replace(law.placed, rivals=itself))
    assert propose(undecided) is None, "0.00 bits are no experiment"


@pytest.mark.parametrize("part", ["flow", "storage"])
def test_a_law_may_sit_at_a_body_that_a_finding_brought(found, part):
    made, d, law = found
    known = d.case
    broth = made.plant.nodes["broth"]
    plant = replace(made.plant, nodes={**made.plant.nodes, "shell": replace(broth, name="shell")})
    rig = known.rig(plant, known.drives(known.null.model))
    c = law_candidate(rig, replace(law.proposal, place=Place("shell", None, part)))
    assert c.place.nodes == {"target": "shell"} and "shell" not in known.plant.nodes


@pytest.mark.parametrize(
    "place",
    [
        Place("one"),
        Place("two", "one"),
        Place("one", None, "storage"),
        Place("one", None, "flow", ("loss_1", "loss_2"), (("two", ex.num(-0.5)),)),
        Place("one", None, "parameter", ("G_1",), (("one", ex.num(-1.0)), ("two", ex.num(0.5)))),
    ],
)
def test_a_plant_with_a_law_of_any_form_at_any_place_can_be_read_again(found, place, tmp_path):
    """A law of the past in a storage brought a flow 'law_storage of velocity': its diagnosis ended in an error."""
    plant = loads(TWO_BLOCKS)
    heat = Signal("heat", ex.name("heat"), "W")
    terms = [f.term(0) for f in families([heat], [heat], 400.0, 1.0)]
    assert {t.form.memory for t in terms} > {None}
    for t in terms:
        c = law_candidate(Rig(plant, [], []), replace(found[2].proposal, place=place, terms=(t,)))
        made = c.extend({q.name: t.shapes.get(q.name[:-1], 0.01) for q in c.effect.parameters})
        save(made, tmp_path / "plant.yaml")
        again = load(tmp_path / "plant.yaml")
        assert (again.nodes.keys(), again.flows.keys()) == (made.nodes.keys(), made.flows.keys())


def test_a_law_reads_the_plants_names_and_no_symbols_of_an_effect():
    """A node `air` was read as the ambient, which is another signal, and a node `s1` as the shape s1."""
    text = TWO_BLOCKS.replace("air: {", "outside: {role: ambient, ").replace(" air", " outside")
    plant = loads(re.sub(r"\bone\b", "air", re.sub(r"\btwo\b", "s1", text)))
    rig = Rig(plant, [], [])
    assert rig.air == "outside"
    read = [Signal(n, ex.name(n), "K", size=2.0) for n in ("air", "s1")]
    terms = tuple(Term(next(f for f in library() if f.name == "tanh"), (s,), {"s": 0.5}) for s in read)
    law = Proposal(Place("s1"), terms, (1.0, 1.0), 0.0, 0.0, limits())
    c = law_candidate(rig, law)
    made = c.extend({"A1": 3.0, "A2": 5.0, "Z1": 2.0, "Z2": 2.0, "s1": 0.5, "s2": 0.5})
    (flow,) = (f for f in made.flows.values() if "law" in f.name)
    own = {q: p.value for q, p in made.parameters.items()}
    got = ex.evaluate(flow.rate, {**own, "air": 1.5, "s1": -0.4, "outside": 99.0})
    assert flow.target == "s1" and got == pytest.approx(3 * np.tanh(1.5) + 5 * np.tanh(-0.4))


ECOSYSTEM = """format: thermoctl-plant/1
title: Plankton and what grazes it
parameters:
  r: {value: 0.7}
  a: {value: 0.2, range: [0.02, 2]}
  kept: {value: 0.6}
  m: {value: 0.25}
nodes:
  algae: {storage: 1, initial: 2.0}
  grazers: {storage: 1, initial: 0.6}
flows:
  growth: {into: algae, rate: r * algae * (1 - algae / 8)}
  grazing: {from: algae, rate: a * algae * grazers}
  gain: {into: grazers, rate: kept * a * algae * grazers}
  death: {from: grazers, rate: m * grazers}
outputs:
  chlorophyll: {value: algae, noise: 0.08}
  count: {value: grazers, noise: 0.04}
"""


def test_a_law_of_a_conversion_acts_in_all_its_flows(tmp_path):
    """Grazing that saturates, by scipy: at one of the two nodes alone it had been a switch."""
    t = np.arange(0.0, 60.0, 0.25)

    def rates(_, x):
        eaten = 0.9 * x[0] ** 2 / (1.6**2 + x[0] ** 2) * x[1]
        return 0.7 * x[0] * (1 - x[0] / 8) - eaten, 0.6 * eaten - 0.25 * x[1]

    x = solve_ivp(rates, (0, 60), [2.0, 0.6], t_eval=t, rtol=1e-9, atol=1e-9).y
    rng = np.random.default_rng(4)
    noisy = x + rng.normal(size=x.shape) * np.array([[0.08], [0.04]])
    table = Table("run", "", t, dict(zip(("chlorophyll", "count"), noisy, strict=True)))
    d = diagnose(loads(ECOSYSTEM), [table], {}, limits())
    place = d.law.proposal.place
    assert (place.of, place.target, [n for n, _ in place.shares]) == (
        ("gain", "grazing"),
        "grazers",
        ["algae"],
    )
    laws = [f for f in d.final.plant.flows.values() if "law" in f.name]
    own = {q: p.value for q, p in d.final.plant.parameters.items()} | {"algae": x[0], "grazers": x[1]}
    found = {f.target: ex.evaluate(f.rate, own) for f in laws}
    assert found["algae"] == pytest.approx(-found["grazers"] / 0.6)
    whole = found["grazers"] + 0.6 * own["a"] * x[0] * x[1]
    assert np.std(whole - 0.54 * x[0] ** 2 / (1.6**2 + x[0] ** 2) * x[1]) < 0.05 * np.std(whole)
    entry = law_entry(d.laws, d.worth)
    assert entry["where"] == "gain and grazing" and entry["effect"] is None
    assert ", -(1 / kept) times it into algae, " in law_sentence(entry)
    with pytest.raises(InputError, match="gain and grazing of this plant alone"):
        save_effect({"remainder": {"law": entry}}, "eaten", tmp_path)


@pytest.mark.parametrize(
    ("second", "share"),
    [
        ("rate: a * algae / m}", ("grazers", "1 / m")),
        ("rate: 2.5 * a * algae}", ("grazers", "2.5")),
        ("rate: r * a * algae}", ("grazers", "r")),
        ("rate: a * algae + m}", None),
        ("rate: a * algae * grazers}", None),
    ],
)
@pytest.mark.parametrize("end", ["into", "from"])
def test_flows_that_are_always_in_proportion_are_one_place(second, share, end):
    text = ECOSYSTEM.split("flows:")[0] + "flows:\n  one: {into: algae, rate: a * algae}\n"
    text += "  rest: {from: algae, rate: r * kept * m * algae**2}\n"
    text += f"  two: {{{end}: grazers, {second}\noutputs:" + ECOSYSTEM.split("outputs:")[1]
    plant = loads(text)
    found = conversions(plant, list(plant.nodes))
    assert bool(found) == bool(share)
    if share:
        sign = "" if end == "into" else "-"
        (((node, e),),) = [p.shares for p in found]
        values = {q: p.value for q, p in plant.parameters.items()}
        wanted = ex.evaluate(ex.parse(f"{sign}({share[1]})"), values)
        assert (node, ex.evaluate(e, values)) == (share[0], pytest.approx(wanted))


BRAKE = """\
format: thermoctl-plant/1
title: Brake of a flywheel
inputs:
  torque: {unit: N*m}
  clamp: {unit: N}
parameters:
  mu: {value: 0.42, unit: "1", range: [0.1, 0.8]}
  b: {value: 0.025, unit: N*m*s, range: [0, 0.3]}
  C: {value: 760, unit: J/K, range: [200, 2500]}
  G: {value: 7, unit: W/K, range: [1, 40]}
nodes:
  w: {unit: 1/s, storage: 1.9, initial: 0}
  T: {unit: degC, storage: C, initial: 21}
flows:
  drive: {into: w, rate: torque, unit: N*m}
  bearing: {from: w, rate: b * w, unit: N*m}
  brake: {from: w, rate: mu * clamp * 0.12 * tanh(w / 2), unit: N*m}
  heat: {into: T, rate: mu * clamp * 0.12 * tanh(w / 2) * w, unit: W}
  loss: {from: T, rate: G * (T - 21), unit: W}
outputs:
  speed: {value: w, unit: 1/s, noise: 0.15}
  disc: {value: T, unit: degC, noise: 1.0}
"""


def test_a_parameter_in_several_flows_may_depend_on_a_signal(tmp_path):
    """A brake fades: its torque and its heat fell by laws of their own, each with a misfit."""
    t, rng = np.arange(0.0, 300.0, 0.5), np.random.default_rng(5)
    levels = {"torque": (0.0, 18.0, 24.0, 28.0), "clamp": (0.0, 500.0, 800.0, 1100.0)}
    drives = {n: np.repeat(rng.choice(v, 20), 30) for n, v in levels.items()}

    def mu(hot):
        return 0.36 - 0.0007 * (hot - 21)

    def rates(at, x):
        torque, clamp = (drives[n][min(int(at / 0.5), len(t) - 1)] for n in levels)
        brake = mu(x[1]) * clamp * 0.12 * np.tanh(x[0] / 2)
        return (torque - brake - 0.035 * x[0]) / 1.9, (brake * x[0] - 9 * (x[1] - 21)) / 640

    x = solve_ivp(rates, (0, t[-1]), [0.0, 21.0], t_eval=t, rtol=1e-8, atol=1e-8, max_step=0.25).y
    noisy = x + rng.normal(size=x.shape) * np.array([[0.15], [1.0]])
    table = Table("run", "", t, {**drives, "speed": noisy[0], "disc": noisy[1]})
    d = diagnose(loads(BRAKE), [table], {}, limits())
    entry = law_entry(d.laws, d.worth)
    assert (entry["part"], entry["where"], entry["of"]) == ("parameter", "mu", ["T"])
    assert law_sentence(entry).startswith("A law for it: a change of the parameter mu, ")
    own = {q: p.value for q, p in d.final.plant.parameters.items()} | {"T": np.linspace(30, 200, 9)}
    found = own["mu"] + ex.evaluate(law_rate(d.final, d.laws[0].placed), own)
    assert found == pytest.approx(mu(own["T"]), rel=0.03)
    with pytest.raises(InputError, match="mu of this plant alone"):
        save_effect({"remainder": {"law": entry}}, "fading", tmp_path)


TANK = """\
format: thermoctl-plant/1
title: Open tank with a heater
inputs:
  heater: {unit: W}
  air: {unit: degC, role: ambient}
parameters:
  C_w: {value: 40000, unit: J/K, range: [10000, 100000]}
  C_l: {value: 4300, unit: J/K, range: [1000, 20000]}
  G_w: {value: 75, unit: W/K, range: [5, 400]}
  G_a: {value: 9, unit: W/K, range: [1, 60]}
nodes:
  water: {unit: degC, storage: C_w, initial: 21, initial_sigma: 0.1}
  wall: {unit: degC, storage: C_l, initial: 21, initial_sigma: 0.2}
flows:
  heat: {into: water, rate: heater, unit: W}
  film: {from: water, into: wall, rate: G_w * (water - wall), unit: W}
  loss: {from: wall, rate: G_a * (wall - air), unit: W}
outputs:
  T_water: {value: water, unit: degC, noise: 0.12}
  T_wall: {value: wall, unit: degC, noise: 0.2}
"""


def test_a_law_takes_the_place_of_effects_that_it_makes_needless():
    """Beside three effects no law was tried: a conductance that grows stood for water that evaporates."""
    t = np.arange(650) * 30.0
    levels = np.repeat([0.0, 2400, 900, 2800, 400, 0], [4, 150, 100, 135, 100, 161])

    def pressure(hot):
        return 610.8 * np.exp(17.27 * hot / (hot + 237.3))

    def rates(at, x):
        film = 95 * (x[0] - x[1])
        vapour = 0.014 * (pressure(x[0]) - 0.5 * pressure(21.0))
        heat = levels[min(int(at / 30), len(t) - 1)]
        return (heat - film - vapour) / 33000, (film - 7 * (x[1] - 21)) / 5200, (x[0] - x[2]) / 120

    x = solve_ivp(rates, (0, t[-1]), [21.0] * 3, t_eval=t, rtol=1e-7, atol=1e-7, max_step=30).y
    rng = np.random.default_rng(3)
    read = {"T_water": x[2] + 0.12 * rng.normal(size=len(t)), "T_wall": x[1] + 0.2 * rng.normal(size=len(t))}
    table = Table("run", "", t, {"heater": levels, "air": np.full(len(t), 21.0), **read})
    imitate = ("temperature_dependent_conductance", "sensor_lag", "sensor_drift")
    d = diagnose(loads(TANK), [table], {n: catalogue()[n] for n in imitate}, limits())
    named = contract(d)["findings"]
    assert [(f["effect"], f["where"]) for f in named] == [("sensor_lag", "T_water")]
    assert d.law.proposal.place == Place("water")
    at = np.array([40.0, 60.0, 80.0, 100.0])
    own = {q: p.value for q, p in d.final.plant.parameters.items()} | {"water": at}
    lost = -ex.evaluate(law_rate(d.final, d.law.placed), own)
    assert lost == pytest.approx(0.014 * (pressure(at) - 0.5 * pressure(21.0)), rel=0.15)


def test_parameters_that_scale_together_absorb_no_flow():
    made = make(next(law for law in LAWS if law.name == "thermostat"), "reactor", "small", "closed", 7)
    known = case(made.plant, made.tables[:2], {}, Budget(80))
    at = tracked(known, fitted(known, known.plant, (), known.null), ["broth", "substrate"])
    share = {n: _explained(x, at.target) for n, x in at.free.items()}
    assert share["broth"] > 0.5 > share["substrate"]


BUDWORM = """\
format: thermoctl-plant/1
title: A population with logistic growth
inputs:
  moths: {}
parameters:
  r: {value: 0.45, range: [0.1, 1.5]}
  K: {value: 11.0, range: [5, 30]}
nodes:
  N: {storage: 1, initial: first(density), initial_sigma: 0.06}
flows:
  growth: {into: N, rate: r * N * (1 - N / K)}
  immigration: {into: N, rate: moths}
outputs:
  density: {value: N, noise: 0.06}
"""


def test_a_plant_that_leaves_its_bounds_is_tracked_with_shorter_steps():
    """A whole step made the population negative: it ran away, and laws were proposed about the bad refit."""
    plant, t = loads(BUDWORM), np.arange(0, 40, 0.25)
    birds = Flow("birds", ex.parse("1.6 * N**2 / (1.44 + N**2)"), "N", None)
    truth = compile_plant(replace(plant, flows={**plant.flows, "birds": birds}))
    moths = 0.4 + 0.3 * np.sign(np.sin(t / 4))
    starts = ({"density": np.full(len(t), n)} for n in (0.5, 3.2, 11.0))
    tables = [truth.measure(Table(f"run_{k}", "", t, {"moths": moths, **s}), k) for k, s in enumerate(starts)]
    known = case(plant, tables, {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    assert null.rough.rms()["density"] > 1.0  # the population must not be near its recordings
    metric = tracked(known, null, ["N"]).metric
    errors = [d.y - run.y for d, run in zip(metric.drives, metric.runs, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.06


def test_the_response_to_a_law_is_that_of_the_plant_with_it_however_fast_it_moves():
    """Hat functions, 400 over a recording, did not resolve a stage that vibrates: a motor with two gains was drag."""
    plant, t = loads(SPRING_STAGE), np.arange(0, 20, 0.0005)
    force = 8.0 * np.sin(2 * np.pi * 7.0 * t)
    table = compile_plant(plant).measure(Table("run", "", t, {"force": force}), 1)
    known = case(plant, [table], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    metric = Metric(Plain(known, null.rough), null.average, False)
    own, size = metric.signals[0], 1e-3
    q = np.abs(own["force"]) * np.tanh(own["velocity"] / 1e-3)
    more = Flow("more", ex.parse(f"{size} * abs(force) * tanh(velocity / 0.001)"), "velocity", None)
    with_it = compile_plant(replace(null.rough_plant, flows={**null.rough_plant.flows, "more": more}))
    moved = with_it.run(known.drives(with_it)[0], dx0=null.rough.dx0[0]).y - metric.runs[0].y
    truth = metric.project(metric.rows(0, moved / -size))
    (found,) = Tracked(metric, metric.residual, {}).columns(Place("velocity"), [q[:, None]]).T
    assert np.linalg.norm(found - truth) < 0.05 * np.linalg.norm(truth)


@pytest.mark.parametrize(("visited", "relays"), [((1.0, 1.0, 1.0), 0), ((0.0, 0.5, 1.0), 1)])
def test_a_signal_of_one_value_has_no_thresholds(visited, relays):
    """Nine tenths of a recording at one value: all pairs of thresholds were equal, and the search crashed."""
    signal = Signal("z", ex.name("z"), None, visited=visited)
    found = families([signal], [signal], 100.0, 1.0)
    t = np.arange(100.0)
    assert sum(f.form.name == "relay" for f in found) == relays
    assert all(f.values({"z": np.sin(t)}, t).shape == (100, f.count * len(f.form.sizes)) for f in found)


CLAMP = """\
format: thermoctl-plant/1
title: Resistor and capacitor
inputs:
  u: {unit: V, between_samples: linear}
parameters:
  C: {value: 1.1e-5, unit: F, range: [5.0e-6, 2.0e-5]}
nodes:
  v: {unit: V, storage: C, initial: 0}
flows:
  charging: {into: v, rate: (u - v) / 1000, unit: A}
outputs:
  v_read: {value: v, unit: V, noise: 0.012}
"""


def test_a_diode_is_an_exponential():
    """A diode's current grows e-fold in 26 to 50 mV: it was steeper than the library, and a sum of two kinks."""
    plant, t = loads(CLAMP), np.arange(0, 0.4, 0.0008)
    diode = Flow("diode", ex.parse("2e-9 * (exp(v / 0.046) - 1)"), "v", None)
    truth = compile_plant(replace(plant, flows={**plant.flows, "diode": diode}))
    drives = (1.5 * np.sin(57 * t) + 0.1, 2.2 * np.sin(31 * t))
    tables = [truth.measure(Table(f"run_{k}", "", t, {"u": u}), k) for k, u in enumerate(drives)]
    known = case(plant, tables, {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    steep = [
        p
        for p in propose_laws(known, null, limits())
        if (p.place, [x.form.name for x in p.terms]) == (Place("v"), ["exponential"])
    ]
    law = refitted_law(known, null, steep[0], null)
    (term,) = steep[0].terms
    own = law.hypothesis.effects[0].own
    assert abs(law.plant.parameters[own["s1"]].value * term.signals[0].size - 0.046) < 0.002


JACKET = """\
format: thermoctl-plant/1
title: Iron with a water jacket
inputs:
  joule: {unit: W, between_samples: linear}
  pumped: {unit: L/min, between_samples: linear}
  inlet: {unit: degC, between_samples: linear, role: temperature}
  air: {unit: degC, between_samples: linear, role: ambient}
parameters:
  C: {value: 3000, unit: J/K, range: [1000, 9000]}
  G_jacket: {value: 10, unit: W/K, range: [1, 60]}
  G_air: {value: 1.0, unit: W/K, range: [0.1, 6]}
nodes:
  iron: {unit: degC, storage: C, initial: inlet, initial_sigma: 0.5}
flows:
  heat: {into: iron, rate: joule, unit: W}
  jacket: {from: iron, rate: G_jacket * (iron - inlet), unit: W}
  to_air: {from: iron, rate: G_air * (iron - air), unit: W}
outputs:
  T: {value: iron, unit: degC, noise: 0.15}
"""


@pytest.mark.parametrize("read", [True, False], ids=["read", "unread"])
def test_a_coolant_takes_heat_as_its_flow_times_its_distance_to_the_inlet(read):
    """The flow had to have a role, though none says "flow"; differences were tried to the ambient only.

    A column that the plant file does not name was no signal of a law. A second thermometer is none: a law of
    it would lead the plant to its own recording."""
    plant, t = loads(JACKET), np.arange(0, 6000, 8.0)
    cooled = Flow("cooled", ex.parse("3.1 * pumped * (iron - inlet)"), "iron", None)
    truth = compile_plant(replace(plant, flows={**plant.flows, "cooled": cooled}))
    drives = {
        "joule": 600 * (np.sin(t / 400) > 0) + 200,
        "pumped": 4 + 2 * np.sin(t / 270),
        "inlet": 18 + 3 * np.sin(t / 900),
        "air": 23 - 2 * np.sin(t / 1300),
    }
    if not read:
        plant = replace(plant, inputs={i: q for i, q in plant.inputs.items() if i != "pumped"})
    table = truth.measure(Table("run", "", t, drives), 1)
    table.columns["second"] = table.columns["T"] + np.random.default_rng(2).normal(0, 0.5, len(t))
    known = case(plant, [table], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    best, *others = propose_laws(known, null, limits())
    read = {s.label for p in (best, *others) for x in p.terms for s in x.signals}
    assert "second" not in read
    assert {s.label for term in best.terms for s in term.signals} == {"pumped", "iron - inlet"}
    law = refitted_law(known, null, best, null)
    assert "pumped" in law.plant.inputs and law.fit.rms()["T"] < 0.16


FOLLOWER = """\
format: thermoctl-plant/1
title: A car that follows another one
inputs:
  v_lead: {unit: m/s, between_samples: linear}
parameters:
  k: {value: 0.06, unit: 1/s**2, range: [0.01, 0.3]}
  headway: {value: 1.5, unit: s}
nodes:
  v: {unit: m/s, storage: 1, initial: 20, initial_sigma: 0.2}
  gap: {unit: m, storage: 1, initial: 30, initial_sigma: 0.5}
flows:
  keep: {into: v, rate: k * (gap - 4 - headway * v), unit: m/s**2}
  close: {into: gap, rate: v_lead - v, unit: m/s}
outputs:
  speed: {value: v, unit: m/s, noise: 0.05}
  radar: {value: gap, unit: m, noise: 0.1}
"""


def test_a_flow_may_go_with_a_quotient_and_with_the_distance_to_an_input():
    """Neither was in the library: a sum of two exponentials of the speeds had been found instead."""
    plant, t = loads(FOLLOWER), np.arange(0.0, 240.0, 0.4)
    closing = Flow("closing", ex.parse("9 * (v_lead - v) / gap"), None, "v")
    truth = compile_plant(replace(plant, flows={**plant.flows, "closing": closing}))
    table = truth.measure(Table("run", "", t, {"v_lead": 20 + 4 * np.sin(t / 6) + 3 * np.sin(t / 31)}), 1)
    known = case(plant, [table], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    best = propose_laws(known, null, limits())[0]
    assert {s.label for term in best.terms for s in term.signals} == {"gap", "v - v_lead"}
    law = refitted_law(known, null, best, null)
    assert law.plant.parameters["n1_law_v"].value == pytest.approx(-1, abs=0.05)
    assert law.fit.rms()["speed"] < 0.055


CLIMATE = """\
format: thermoctl-plant/1
title: A planet whose ice reflects the sun
inputs:
  sun: {between_samples: hold}
parameters:
  C: {value: 20, range: [5, 80]}
  a: {value: 180, range: [100, 260]}
  b: {value: 3.0, range: [0.5, 6]}
nodes:
  T: {storage: C, initial: 10, initial_sigma: 2}
flows:
  in: {into: T, rate: 0.7 * sun}
  out: {from: T, rate: a + b * T}
outputs:
  thermometer: {value: T, noise: 0.15}
"""


def test_a_flow_may_go_with_a_step_of_any_width_of_one_signal_times_another():
    """A step of fixed width, and a peak, had been found instead (the albedo of ice, Budyko 1969)."""
    plant, t = loads(CLIMATE), np.arange(0.0, 200.0)
    less = Flow("less", ex.parse("0.09 * sun * tanh((T - 8) / 5)"), None, "T")
    truth = compile_plant(replace(plant, flows={**plant.flows, "less": less}))
    sun = np.repeat(np.random.default_rng(5).uniform(180, 420, 20), 10)
    table = truth.measure(Table("run", "", t, {"sun": sun}), 1)
    known = case(plant, [table], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    best = propose_laws(known, null, limits())[0]
    assert [(x.form.name, {s.label for s in x.signals}) for x in best.terms] == [
        ("logistic_product", {"T", "sun"})
    ]
    law = refitted_law(known, null, best, null)
    assert law.fit.rms()["thermometer"] < 0.16


ENZYME = """\
format: thermoctl-plant/1
title: An enzyme without inhibition
parameters:
  Vmax: {value: 0.7, range: [0.05, 10]}
  Km: {value: 5}
nodes:
  S: {storage: 1, initial: first(substrate), initial_sigma: 0.3}
  P: {storage: 1, initial: first(product), initial_sigma: 0.3}
flows:
  conversion: {from: S, into: P, rate: Vmax * S / (Km + S)}
outputs:
  substrate: {value: S, noise: 0.2}
  product: {value: P, noise: 0.2}
"""


def test_a_law_may_change_a_flow_of_the_plant_beside_a_column_of_noise():
    """The product inhibits. A sum of three terms had been found, with a recorded temperature that never changed."""
    plant, tables = loads(ENZYME), []
    inhibited = ENZYME.replace("0.7", "1.1").replace("(Km + S)", "(Km + S) / (1 + P / 6)")
    truth = compile_plant(loads(inhibited))
    for k, (s, p) in enumerate([(30.0, 0.0), (20.0, 15.0), (40.0, 5.0)]):
        t = np.arange(0.0, 120.0, 3.0)
        start = {"substrate": np.full(len(t), s), "product": np.full(len(t), p)}
        tables.append(truth.measure(Table(f"run_{k}", "", t, start), k))
        tables[-1].columns["temp"] = 25 + np.random.default_rng(k).normal(0, 0.1, len(t))
    known = case(plant, tables, {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    best = propose_laws(known, null, limits())[0]
    assert [(x.form.name, x.variables) for x in best.terms] == [("saturation_product", {"P", "conversion"})]
    law = refitted_law(known, null, best, null)
    assert max(law.fit.rms().values()) < 0.22


def test_a_column_that_a_recording_set_aside_lacks_is_no_signal():
    """A law of the voltage was found, and then could not be measured there: the diagnosis ended in an error."""
    plant, t = loads(CLAMP), np.arange(0, 0.2, 0.0008)
    table, aside = (
        compile_plant(plant).measure(Table(name, "", t, {"u": np.sin(57 * t)}), 1)
        for name in ("run", "aside")
    )
    table.columns["room"] = np.cos(9 * t)
    tables = [table]
    assert "room" in sought(plant, tables, {}, limits()).case.tables[0].columns
    assert "room" not in sought(plant, tables, {}, limits(), [aside]).case.tables[0].columns


def test_a_second_reading_of_several_bodies_is_no_signal():
    """A second displacement sensor follows no single body."""
    reading = "  bent: {value: one - 2 * two, unit: K, noise: 0.05}\n"
    plant, t = loads(TWO_BLOCKS + reading), np.arange(0, 4000, 4.0)
    drives = {"heat": 20.0 * (np.sin(t / 300) > 0), "air_temperature": 22 + np.sin(t / 800)}
    table = compile_plant(plant).measure(Table("run", "", t, drives), 1)
    table.columns["laser"] = table.columns["bent"] + np.random.default_rng(2).normal(0, 0.05, len(t))
    table.columns["pressure"] = np.cos(t / 170)
    known = case(plant, [table], {}, Budget(80))
    metric = Metric(Plain(known, known.null), fitted(known, plant, (), known.null).average, True)
    found = signals(known.rig(plant, metric.drives), Place("one"), metric.signals)
    assert {"laser", "pressure"} & {s.label for s in found} == {"pressure"}


GEAR = """
format: thermoctl-plant/1
title: Two wheels that a spring joins
nodes:
  a: {unit: rad, storage: 1, initial: 0}
  va: {unit: rad/s, storage: 1, initial: 0}
  b: {unit: rad, storage: 1, initial: 0}
  vb: {unit: rad/s, storage: 1, initial: 0}
flows:
  turn_a: {into: a, rate: va, unit: rad/s}
  turn_b: {into: b, rate: vb, unit: rad/s}
  tooth: {from: va, into: vb, rate: 40 * (a - b), unit: rad/s**2}
outputs:
  angle: {value: a, unit: rad, noise: 0.001}
"""


@pytest.mark.parametrize(("offset", "centre"), [(0.0, 0.0), (-0.15, 0.0), (2.0, 2.4)])
def test_signals_of_a_coupling_are_the_twist_and_positions_from_a_zero_that_is_near(offset, centre):
    """Play depends on the twist; a spring about zero needed a constant beside it."""
    rig, t = Rig(loads(GEAR), [], []), np.linspace(0, 1, 50)
    run = {"t": t, "a": offset + 0.4 + 0.4 * np.sin(9 * t), "b": offset + 0.1 * t, "va": t, "vb": t**2}
    found = {s.label: s for s in signals(rig, Place("vb", "va"), [run])}
    assert found["a - b"].drives and found["va - vb"].drives
    assert found["a"].position and found["a"].centre == pytest.approx(centre, abs=0.1)


@pytest.mark.parametrize("drains", [False, True], ids=["feeds", "drains"])
def test_a_pump_at_another_vessel_than_the_plant_file_says_is_told(drains):
    pump = "inputs:\n  spare: {unit: V}\n"
    stated, true = ("from: lower", {"source": "upper"}) if drains else ("into: upper", {"target": "lower"})
    text = TANKS.replace("inputs:\n", pump).replace(
        "flows:\n", f"flows:\n  moved: {{{stated}, rate: 0.2 * spare}}\n"
    )
    plant, t = loads(text), np.arange(0, 1200, 3.0)
    moved = replace(plant.flows["moved"], **true)
    truth = compile_plant(replace(plant, flows={**plant.flows, "moved": moved}))
    on = {"pump": 1 + (np.sin(t / 90) > 0), "spare": 0.5 + (np.sin(t / 140) > 0.2)}
    known = case(plant, [truth.measure(Table("run", "", t, on), 1)], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    led = [p for p in propose_laws(known, null, limits()) if p.place == Place("lower", "upper")]
    led = [p for p in led if [(x.form.name, *x.variables) for x in p.terms] == [("linear", "spare")]]
    moving = refitted_law(known, null, led[0], null)
    law = SimpleNamespace(proposal=led[0], fitted=moving, placed=laws_of(moving)[0])
    (told,) = wrong_ends(known, law)
    assert "start at upper, and not lower" in told if drains else "end in lower, and not upper" in told


@pytest.mark.parametrize(("least", "twins"), [(0.1, set()), (-0.1, set()), (-1.0, {"even", "even_power"})])
def test_a_signal_that_is_nowhere_negative_is_not_tried_with_two_equal_forms(least, twins):
    """Of a leak of a tank, abs(z)**n and sign(z) * abs(z)**n had half the probability each, and an experiment."""
    signal = Signal("z", ex.name("z"), None, visited=(least, 0.5, 1.0))
    tried = {f.form.name for f in families([signal], [signal], 100.0, 1.0)}
    assert tried & {"even", "even_power"} == twins and {"linear", "power"} <= tried


def test_a_relay_in_the_plant_switches_where_the_one_of_the_regression_does():
    t = np.arange(400.0)
    z = np.sin(t / 30) + 0.3 * np.sin(t / 7)
    form = next(f for f in library() if f.name == "relay")
    signal = Signal("z", ex.name("z"), None)
    table = Table("made", "", t, {"z": z})
    for on, off in ((0.6, -0.4), (-0.5, 0.7)):
        term = Term(form, (signal,), {"on": on, "off": off}, 400.0, 1.0)
        rate = ex.substitute(
            term.filling(1),
            lambda e, known={"on1": on, "off1": off, "Z1": 1.0}: (
                ex.num(known[e.value]) if e.value in known else None
            ),
        )
        plant = Plant(
            "relay",
            {"z": Input("z", None, "z", True)},
            {},
            {"m1": Node("m1", ex.ONE, ex.num(0.5))},
            {"switching": Flow("switching", rate, None, "m1")},
            {},
        )
        m = compile_plant(plant).simulate(table).x[:, 0]
        other = (m > 0.5) != (term.values({"z": z}, t)[:, 0] > 0.5)
        assert np.sum(np.diff(m > 0.5)) > 3 and np.mean(other) < 0.05  # a switch takes some samples


@pytest.fixture(scope="module")
def switched():
    made = make(next(law for law in RELAYS if law.family == "reactor"), "reactor", "small", "closed", 7)
    return made, *look(made)


def test_a_thermostat_with_hysteresis_is_a_law_with_two_thresholds(switched):
    made, d, law = switched
    (term,) = law.proposal.terms
    values = {q: p["value"] for q, p in law_entry([law], d.worth)["parameters"].items()}
    signal = term.signals[0]
    assert (term.form.name, signal.label) == ("relay", "broth")
    on, off = (signal.centre + values["Z1"] * values[q] for q in ("on1", "off1"))
    assert abs(on - 31) < 0.5 and abs(off - 26) < 0.5
    assert difference(law.fitted.plant, made) < EQUAL


def test_a_saved_relay_is_an_effect(switched, tmp_path):
    made, d, law = switched
    result = {"remainder": {"law": law_entry([law], d.worth)}}
    save_effect(result, "thermostat", tmp_path / "own")
    save(made.plant, tmp_path / "plant.yaml")
    assert main(["effects", "check", str(tmp_path / "own"), "--plant", str(tmp_path / "plant.yaml")]) == 0


def test_a_larger_storage_is_no_law_where_the_plant_has_a_parameter_for_it():
    made = make(ENTROPIC, "reactor", "middle", "closed", 7)
    known = case(made.plant, made.tables[:2], {}, Budget(80))
    at = tracked(known, fitted(known, known.plant, (), known.null), ["broth", "substrate"])
    flows = [np.ones((len(d.t), 1)) for d in at.metric.drives]
    assert abs(_cosine(at, Place("broth", None, "storage"), flows)) < 0.05
    assert (
        abs(_cosine(at, Place("broth"), [np.asarray(run["current"])[:, None] for run in at.metric.signals]))
        > 0.95
    )


def _cosine(at, place, flows):
    x = at.columns(place, flows)[:, 0]
    return float(x @ at.target) / max(float(np.linalg.norm(x) * np.linalg.norm(at.target)), 1e-300)


def test_latent_heat_is_a_law_in_the_storage(tmp_path):
    law = next(law for law in STORAGES if law.family == "heater")
    made = make(law, "heater", "middle", "closed", 7)
    d, found = look(made)
    entry = law_entry([found], d.worth)
    assert (entry["part"], entry["into"]) == ("storage", "one")
    assert difference(found.fitted.plant, made) < EQUAL
    assert law_sentence(entry).startswith("A law for it: a storage of one, C_1 + ")
    save_effect({"remainder": {"law": entry}}, "melting", tmp_path / "own")
    save(made.plant, tmp_path / "plant.yaml")
    assert main(["effects", "check", str(tmp_path / "own"), "--plant", str(tmp_path / "plant.yaml")]) == 0


def test_the_time_of_day_is_a_signal_where_each_hour_was_visited():
    plant = loads(TWO_BLOCKS.replace("inputs:\n", "inputs:\n  clock: {unit: h, role: time_of_day}\n"))
    sun = Flow("sun", ex.parse("0.3 * sin(2 * pi * (clock - 8) / 24)"), None, "one")
    truth = compile_plant(replace(plant, flows={**plant.flows, "sun": sun}))
    rng, t = np.random.default_rng(1), np.arange(900) * 100.0
    tables = []
    for k in range(3):
        heat = np.repeat(rng.permutation([0, 2.5, 0.8, 0, 1.6, 3]), 150)
        columns = {"heat": heat, "air_temperature": np.full(900, 21.0), "clock": (6 * k + t / 3600) % 24}
        tables.append(truth.measure(Table(f"run_{k}", "", t, columns), k))
    _, law = look(SimpleNamespace(plant=plant, tables=tables))
    assert [(t.form.name, t.variables) for t in law.proposal.terms] == [("daily", {"clock"})]
    rig = Rig(plant, [truth.excitation(t) for t in tables], [t.columns for t in tables])
    assert not any(s.daily for s in signals(rig, Place("one"), [_named(tables[0], 800)]))
    assert any(s.daily for s in signals(rig, Place("one"), [_named(tables[0], 900)]))


def _named(table, count):
    rows = {k: v[:count] for k, v in table.columns.items()}
    return {"t": table.t[:count], **dict.fromkeys(("one", "two", "air"), np.arange(count)), **rows}


def test_friction_that_grows_with_the_load_is_not_taken_for_dry_friction_that_leaves_only_noise():
    plant, t = loads(SPRING_STAGE), np.arange(0, 15, 0.01)
    gear = Flow("gear", ex.parse("1e-4 * abs(force) * tanh(velocity / 0.001)"), "velocity", None)
    truth, tables = compile_plant(replace(plant, flows={**plant.flows, "gear": gear})), []
    for k in (1, 2):
        force = np.interp(t, np.arange(0, 16, 0.5), np.random.default_rng(k).uniform(-10, 10, 32))
        tables.append(truth.measure(Table(f"run_{k}", "", t, {"force": force}), k))
    d = diagnose(plant, tables, catalogue(), limits())
    assert d.law and [(t.form.name, t.variables) for t in d.law.proposal.terms] == [
        ("load_friction", {"velocity", "force"})
    ]
    friction = next(
        w for w in d.searched.tried if w.fitted.hypothesis.keys == {("coulomb_friction", "velocity")}
    )
    assert only_noise(d.case, friction.fitted) and d.decision.named == (("law", "velocity"),)


def test_no_law_is_claimed_where_nothing_is_missing():
    assert look(make(None, "stage", "small", "closed", 3))[1] is None


def test_a_law_that_recordings_set_aside_do_not_confirm_is_no_finding():
    """The battery's reversible heat, in its published form or one as likely, starts at another charge in the others.

    Its voltage, which the plant does not read, tells the charge in all of them."""
    if not FOLDER.is_dir():
        pytest.skip(f"{FOLDER}: no such folder; set THERMOCTL_RECORDINGS to the folder of the recordings")
    rig = next(r for r in RIGS if r.name == "battery")
    d = law_of(FOLDER, rig, ["voltage"])
    law = laws_of(d.searched.tried[0].fitted)[0]
    fitting = [law.proposal, *(p for p, _, _ in law.rivals)]
    assert [("total_product", {"current"})] in [
        [(t.form.name, t.variables) for t in p.terms] for p in fitting
    ]
    assert d.law is None and d.refused == {("law", "cell")}
    (told,) = (a["expression"] for a in contract(d)["alternatives"] if a["effect"] == "law")
    assert "current" in told and re.search(r"\d", told)
    voltage = law_of(FOLDER, rig).law
    assert voltage and "voltage" in {s.label for t in voltage.proposal.terms for s in t.signals}


@pytest.mark.slow  # twenty seconds
@pytest.mark.xfail(strict=True, reason="from n = 0.6 the refit ends at a bound of mu, 8 nats below n = 2.06")
def test_the_published_form_of_the_pendulums_law_is_among_those_that_fit_as_well():
    """Dry friction and square drag; a tanh in place of the power fits 0.1 nats better, beside the plant's damping."""
    if not FOLDER.is_dir():
        pytest.skip(f"{FOLDER}: no such folder; set THERMOCTL_RECORDINGS to the folder of the recordings")
    law = law_of(FOLDER, next(r for r in RIGS if r.name == "pendulum")).law
    laws = [(law.proposal, law.fitted, law.share), *law.rivals]
    (found,) = (x for x in laws if {t.form.name for t in x[0].terms} == {"friction", "power"})
    _, fit, share = found
    (power,) = (p.value for n, p in fit.plant.parameters.items() if n.startswith("n"))
    assert 1.8 < power < 2.2 and share > 0.2


@pytest.mark.slow  # a minute: the whole diagnosis
@pytest.mark.parametrize(
    "name",
    [
        "tanks: log(1 + 3 * x**2) of upper | middle | open",
        "tanks: siphon | large | closed",
        "heater: fan with hysteresis | middle | open",
    ],
)
def test_no_name_stands_beside_a_law_or_in_its_place(name):
    """Two sensor faults stood for the first law, an overflow beside the second, a heat source beside the third."""
    law, *case_of = next(c[1:] for c in cases() if c[0] == name)
    made = make(law, *case_of)
    d = diagnose(made.plant, made.tables[:3], catalogue(), limits())
    assert not d.shown
    assert d.law.proposal.place == Place(law.target)


def bowed(text):
    """Two blocks, whose first thermometer has an error of its reading."""
    truth = compile_plant(loads(TWO_BLOCKS.replace("value: one", f"value: 'one + {text}'")))
    t = np.arange(450) * 8.0
    tables = []
    for k in range(2):
        heat = np.repeat(np.random.default_rng(k).permutation([0, 2.5, 0.8, 0, 1.6, 3]), 75)
        tables.append(
            truth.measure(Table(f"run_{k}", "", t, {"heat": heat, "air_temperature": 21 + 0 * t}), k)
        )
    return tables


@pytest.mark.parametrize(
    ("error", "form", "power", "size"),
    [("0.004 * (one - 21)**2", "curved", 2, 0.004), ("-0.15 * max(one - 40, 0)", "above", 1, -0.15)],
)
def test_a_sensor_that_is_not_linear_is_a_law_of_its_reading(error, form, power, size, tmp_path):
    """Two effects of the body, a heat capacity and a conductance that vary, had each been named above 0.99."""
    known = {n: catalogue()[n] for n in ("variable_heat_capacity", "temperature_dependent_conductance")}
    d = diagnose(loads(TWO_BLOCKS), bowed(error), known, limits())
    (law,) = d.laws
    entry = law_entry([law], d.worth)
    assert not d.shown and d.decision.verdict == "explained"
    assert (entry["part"], entry["where"], entry["into"]) == ("reading", "temperature_1", None)
    assert entry["forms"][0]["form"] == form and entry["parameters"]["A1"]["unit"] == "K"
    assert "an error of the reading temperature_1, one + " in law_sentence(entry)
    own = entry["parameters"]
    assert own["A1"]["value"] / own["Z1"]["value"] ** power == pytest.approx(size, rel=0.15)
    with pytest.raises(InputError, match="at temperature_1 of this plant alone"):
        save_effect({"remainder": {"law": entry}}, "meter", tmp_path / "own")


def test_a_reading_that_is_trusted_has_no_law():
    trusted = TWO_BLOCKS.replace("inputs:", "sensors: trusted\ninputs:", 1)
    for text, wanted in ((TWO_BLOCKS, True), (trusted, False)):
        assert any(p.part == "reading" for p in places(Rig(loads(text), [], []))) == wanted


@pytest.mark.parametrize(
    ("rate", "form", "signals", "shapes"),
    [
        (
            "-0.01 * (step(clock - 8) - step(clock - 20)) * (one - air)",
            "scheduled_product",
            {"clock", "one - air"},
            {"l1": 14 / 24, "s1": 0.5},
        ),
        ("-2e-7 * worked * (one - air)", "worn", {"heat", "one - air"}, {}),
    ],
)
def test_a_schedule_of_the_day_and_what_wears_change_a_flow(rate, form, signals, shapes):
    """A cover at night was a power of the sunshine, and a filter that clogs was unexplained."""
    slow = TWO_BLOCKS.replace("value: 6, unit: J/K, range: [2, 14]", "value: 60, unit: J/K, range: [20, 140]")
    plant = loads(slow.replace("inputs:\n", "inputs:\n  clock: {unit: h, role: time_of_day}\n"))
    more = Flow("more", ex.parse(rate), None, "one")
    inputs = {**plant.inputs, "worked": Input("worked", "J", "worked", False)}
    truth = compile_plant(replace(plant, inputs=inputs, flows={**plant.flows, "more": more}))
    t, tables = np.arange(1000) * 100.0, []
    for k in range(2):
        heat = np.repeat(np.random.default_rng(k).permutation([0, 2.5, 0.8, 0, 1.6]), 200)
        columns = {"heat": heat, "air_temperature": np.full(1000, 21.0), "clock": (7 * k + t / 3600) % 24}
        worked = np.concatenate([[0.0], np.cumsum(heat[:-1] * 100.0)])
        tables.append(truth.measure(Table(f"run_{k}", "", t, {**columns, "worked": worked}), k))
        del tables[-1].columns["worked"]
    (law,) = diagnose(plant, tables, {}, limits()).laws
    assert [x.form.name for x in law.proposal.terms] == [form]
    assert {s.label for x in law.proposal.terms for s in x.signals} == signals
    values = law.fitted.plant.parameters
    assert {q: values[f"{q}_law_one"].value for q in shapes} == pytest.approx(shapes, abs=0.02)


COOLER = """\
format: thermoctl-plant/1
title: Oil cooler, its conductance as a constant
inputs: {heater: {unit: W}, flow: {unit: kg/s}, inlet: {unit: degC}}
parameters:
  C: {value: 9000, unit: J/K, range: [3000, 30000]}
  G: {value: 300, unit: W/K, range: [90, 900]}
nodes:
  oil: {unit: degC, storage: C, initial: first(oil_t), initial_sigma: 0.1}
  water: {unit: degC, storage: 4000, initial: first(water_t), initial_sigma: 0.1}
flows:
  heat: {into: oil, rate: heater, unit: W}
  wall: {from: oil, into: water, rate: G * (oil - water), unit: W}
  carry: {from: water, rate: flow * 4180 * (water - inlet), unit: W}
outputs:
  oil_t: {value: oil, unit: degC, noise: 0.1}
  water_t: {value: water, unit: degC, noise: 0.1}
"""


def test_a_law_takes_the_place_of_a_flow_whose_range_ends_above_zero():
    """The conductance goes with flow^0.6. A second term had to undo G = 90, which the plant file's range keeps."""
    plant, t = loads(COOLER), np.arange(0, 4000, 5.0)
    rng = np.random.default_rng(5)
    steps = [np.repeat(rng.uniform(a, b, 20), 40) for a, b in ((0, 6000), (0.06, 0.4))]
    drive = {"heater": steps[0], "flow": steps[1], "inlet": np.full(len(t), 15.0)}
    drive |= {"oil_t": np.full(len(t), 40.0), "water_t": np.full(len(t), 20.0)}
    wall = replace(plant.flows["wall"], rate=ex.parse("2.9 * G * flow**0.6 * (oil - water)"))
    truth = compile_plant(replace(plant, flows={**plant.flows, "wall": wall}))
    known = case(plant, [truth.measure(Table("run", "", t, drive), 1)], {}, Budget(80))
    null = fitted(known, plant, (), known.null)
    led = [p for p in propose_laws(known, null, limits()) if p.place == Place("water", "oil")]
    (p,) = [p for p in led if [x.form.name for x in p.terms] == ["product"]]
    form = next(f for f in library() if f.name == "power_product")
    p = replace(p, terms=(replace(p.terms[0], form=form, shapes={"n": 0.8}),))
    f = refitted_law(known, null, p, null)
    assert f.plant.parameters["G"].value < 30 and f.plant.parameters["G"].range == (0.0, 900.0)
    exponent = laws_of(f)[0].own["n1"]
    assert f.plant.parameters[exponent].value == pytest.approx(0.6, abs=3 * f.sd[exponent] + 0.02)
    assert f.sd[exponent] < 0.03
