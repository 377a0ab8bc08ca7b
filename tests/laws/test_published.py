"""Laws of published systems that faults imitate, that are two at once, and that act in chaos."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from tests.bench.laws import smoothed
from tests.bench.published import plant_of
from tests.laws.published import SYSTEMS
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.law.result import save_effect
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report.words import sentences
from thermoctl.plant.files import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def beside_unread(tables):
    """Return the recordings with eight columns more that wander and act on nothing.

    They took the turns of the true signals: laws of such columns were up to 140 nats worse than the truth."""
    rng = np.random.default_rng(3)
    for table in tables:
        wander = lfilter([0.24], [1.0, -0.97], rng.standard_normal((8, len(table.t))))
        table.columns.update({f"other_{k}": 25 + v for k, v in enumerate(wander)})
    return tables


def test_a_law_stands_without_the_names_that_imitate_it():
    """Monod's growth of a reactor, whose first names are two faults of the sensor."""
    system = next(s for s in SYSTEMS if s.name == "bioreactor")
    found = diagnose(loads(system.plant), system.draw(0).tables[:-1], catalogue(), limits())
    assert not found.shown
    assert found.law is not None
    assert [t.form.name for t in found.law.proposal.terms] == ["saturation_product"]


def test_two_laws_missing_at_once_are_found_at_both_places():
    """A saturation and a lag of the sensors were named: each law alone explains less than they do."""
    system = next(s for s in SYSTEMS if "both" in s.name)
    drawn = system.draw(0)
    found = diagnose(plant_of(system, drawn), beside_unread(drawn.tables[:-1]), catalogue(), limits())
    assert not found.shown
    assert set(found.decision.named) == {("law", "rabbits"), ("law", "wolves")}
    for node, size in (("rabbits", -0.9), ("wolves", 0.8)):
        q = {k: found.final.plant.parameters[f"{k}1_law_{node}"].value for k in "AZW"}
        assert q["A"] / (q["Z"] * q["W"]) == pytest.approx(size, rel=0.01)


PHAGES = """
format: thermoctl-plant/1
title: bacteria and phages; that they meet is not in the model
parameters:
  r: {value: 0.9, range: [0.4, 1.5]}
  K: {value: 6.5, range: [3, 12]}
  m: {value: 0.35, range: [0.1, 0.8]}
nodes:
  bacteria: {storage: 1, initial: first(density), initial_sigma: 0.1}
  phages: {storage: 1, initial: first(count), initial_sigma: 0.1}
flows:
  growth: {into: bacteria, rate: r * bacteria * (1 - bacteria / K)}
  decay: {from: phages, rate: m * phages}
outputs:
  density: {value: bacteria, noise: 0.05}
  count: {value: phages, noise: 0.06}
"""


def test_two_laws_are_found_where_one_law_and_a_sensor_imitate_them(tmp_path):
    """A law of memory at the bacteria and a lag of the count: once found, they ended the search for pairs."""
    t = np.arange(0.0, 30.0, 0.4)

    def rates(_, x):
        return x[0] * (1 - x[0] / 6) - 0.6 * x[0] * x[1], 0.21 * x[0] * x[1] - 0.4 * x[1]

    x = solve_ivp(rates, (0, 30), (1.0, 0.5), t_eval=t, rtol=1e-9, atol=1e-9).y
    rng = np.random.default_rng(3)
    table = Table(
        "run", "", t, {"density": x[0] + rng.normal(0, 0.05, 75), "count": x[1] + rng.normal(0, 0.06, 75)}
    )
    found = diagnose(loads(PHAGES), [table], catalogue(), limits())
    assert set(found.decision.named) == {("law", "bacteria"), ("law", "phages")}
    result = contract(found)
    (beside,) = result["remainder"]["law"]["beside"]
    sizes = {}
    for law in (result["remainder"]["law"], beside):
        assert [form["form"] for form in law["forms"]] == ["product"]
        a, z, w = (law["parameters"][q]["value"] for q in ("A1", "Z1", "W1"))
        sizes[law["where"]] = a / (z * w)
        coefficient, *read = law["plain"].replace("(", "").replace(")", "").split(" * ")
        assert read == ["bacteria", "phages"]
        assert float(coefficient) == pytest.approx(a / (z * w), rel=1e-3)
    assert sizes == {"bacteria": pytest.approx(-0.6, rel=0.1), "phages": pytest.approx(0.21, rel=0.1)}
    text = " ".join(sentences(result))
    assert "a law at phages of bacteria and phages and a law at bacteria of bacteria and phages" in text
    saved = [path.name for path in save_effect(result, "meeting", tmp_path)]
    assert saved == ["meeting.yaml", "meeting_2.yaml"]


def test_the_peers_get_the_flow_that_is_missing():
    system = next(s for s in SYSTEMS if "one term" in s.name)
    drawn = system.draw(0)
    _, flows = smoothed(plant_of(system, drawn), drawn.tables[:-1], list(system.missing))
    (signals, x, flow), (node, law) = flows["wolves"], next(iter(system.missing.items()))
    true = law(drawn.truth[0], *system.coefficients[node])
    assert [str(s.value.value) for s in signals] == ["wolves", "rabbits"] and x.shape == (len(flow), 2)
    assert np.median(np.abs(flow - true)) < 0.15 * np.ptp(true)


@pytest.mark.slow  # a minute
def test_the_law_of_a_chaotic_system_is_found_in_pieces():
    system = next(s for s in SYSTEMS if s.name == "Lorenz")
    found = diagnose(loads(system.plant), system.draw(0).tables[:1], catalogue(), limits())
    assert not found.shown
    assert [(t.form.name, t.variables) for t in found.law.proposal.terms] == [("power", {"x"})]
    assert found.law.fitted.plant.parameters["n1_law_x"].value == pytest.approx(3, abs=0.1)


CYLINDER = """
format: thermoctl-plant/1
title: Two chambers beside a piston on a spring, each with a pump; the seal leaks, which is not in the model
inputs:
  one: {unit: m^3/s}
  two: {unit: m^3/s}
parameters:
  A: {value: 1e-3, unit: m^2}
  c: {value: 2e-11, unit: m^3/Pa, range: [1e-11, 5e-11]}
  G: {value: 4e-12, unit: m^3/(s Pa), range: [1e-12, 2e-11]}
  d: {value: 3e5, unit: N*s/m, range: [1e5, 1e6]}
  k: {value: 5e5, unit: N/m, range: [1e5, 2e6]}
nodes:
  a: {unit: Pa, storage: c, initial: 0}
  b: {unit: Pa, storage: c, initial: 0}
  x: {unit: m, storage: d, initial: 0}
flows:
  pump_a: {into: a, rate: one - G * a, unit: m^3/s}
  pump_b: {into: b, rate: two - G * b, unit: m^3/s}
  push: {into: x, rate: A * (a - b) - k * x, unit: N}
outputs:
  pressure_a: {value: a, unit: Pa, noise: 2e3}
  pressure_b: {value: b, unit: Pa, noise: 2e3}
  travel: {value: x, unit: m, noise: 1e-6}
"""


def test_chambers_that_no_flow_links_leak_into_each_other():
    """A leak past a piston was no hypothesis, as only nodes that flows link exchanged what they hold."""
    plant = loads(CYLINDER)
    leaky = CYLINDER.replace(
        "flows:", "flows:\n  leak: {from: a, into: b, rate: 1.2e-12 * (a - b), unit: m^3/s}"
    )
    t, rng = np.arange(0.0, 200.0, 0.5), np.random.default_rng(4)
    pumps = {n: np.repeat(rng.uniform(0, 4e-6, 20), 20) for n in ("one", "two")}
    table = compile_plant(loads(leaky)).measure(Table("r", "r.csv", t, pumps), 1)
    found = diagnose(plant, [table], {}, limits())
    assert found.law is not None and found.law.proposal.place.where == "a-b"
    q = {k: found.law.fitted.plant.parameters[f"{k}1_law_a_b"].value for k in "AZ"}
    assert q["A"] / q["Z"] == pytest.approx(1.2e-12, rel=0.02)


FURNACE = """
format: thermoctl-plant/1
title: An element that heats a load; what it radiates is not in the model
inputs:
  heater: {unit: W}
  air: {unit: degC, role: ambient}
parameters:
  C_element: {value: 150, unit: J/K, range: [50, 400]}
  C_load: {value: 1100, unit: J/K, range: [400, 3000]}
  G: {value: 0.8, unit: W/K, range: [0.1, 4]}
  G_air: {value: 2.0, unit: W/K, range: [0.5, 8]}
nodes:
  element: {unit: degC, storage: C_element, initial: air}
  load: {unit: degC, storage: C_load, initial: air}
flows:
  heating: {into: element, rate: heater, unit: W}
  joint: {from: element, into: load, rate: G * (element - load), unit: W}
  loss: {from: load, rate: G_air * (load - air), unit: W}
outputs:
  TC1: {value: element, unit: degC, noise: 1.0}
  TC2: {value: load, unit: degC, noise: 0.5}
"""
CLAMP = """
format: thermoctl-plant/1
title: A two-stage filter with a diode at its output that is not in the model
inputs:
  source: {unit: V}
parameters:
  R1: {value: 1000, unit: ohm}
  R2: {value: 2200, unit: ohm, range: [1500, 3300]}
  C1: {value: 1.1e-6, unit: F, range: [5e-7, 2e-6]}
  C2: {value: 5.0e-7, unit: F, range: [2e-7, 1e-6]}
nodes:
  v1: {unit: V, storage: C1, initial: 0}
  v2: {unit: V, storage: C2, initial: 0}
flows:
  i1: {into: v1, rate: (source - v1) / R1, unit: A}
  i2: {from: v1, into: v2, rate: (v1 - v2) / R2, unit: A}
outputs:
  ch1: {value: v1, unit: V, noise: 0.003}
  ch2: {value: v2, unit: V, noise: 0.003}
"""


def with_flow(text, flow):
    """Return a plant with one flow more."""
    return loads(text.replace("flows:", f"flows:\n  true: {{{flow}}}"))


def test_bodies_radiate_to_each_other():
    """It was a law of eight sizes, 1180 in chi-square off: only the difference of temperatures was a signal."""
    true = with_flow(
        FURNACE,
        'from: element, into: load, rate: "1.3e-9 * ((element + 273.15)**4 - (load + 273.15)**4)", unit: W',
    )
    t, rng = np.arange(0.0, 5400.0, 9.0), np.random.default_rng(5)
    inputs = {"heater": np.repeat(rng.uniform(50, 900, 20), 30), "air": 21 + 0.3 * np.sin(t / 900)}
    table = compile_plant(true).measure(Table("r", "r.csv", t, inputs), 2)
    found = diagnose(loads(FURNACE), [table], {}, limits())
    assert found.decision.named == (("law", "element-load"),)
    assert [s.label for p in found.law.proposal.terms for s in p.signals] == ["element^4 - load^4"]
    q = {k: found.law.fitted.plant.parameters[f"{k}1_law_element_load"] for k in "AZ"}
    assert q["A"].value / q["Z"].value == pytest.approx(1.3e-9, rel=0.02) and q["Z"].unit == "K**4"


def test_a_step_that_ends_at_its_bound_is_tried_as_an_exponential():
    """A diode was a law of three terms: the logistic step that leads ended at its bound, and nothing followed."""
    text = CLAMP.replace("storage: C2", 'storage: "C2 * (1 - 0.01 * v2)"')  # a misfit that nobody names
    true = with_flow(text, 'from: v2, rate: "2.2e-8 * (exp(v2 / 0.052) - 1)", unit: A')
    t, rng = np.arange(0.0, 0.3, 2e-4), np.random.default_rng(6)
    steps = np.repeat(rng.uniform(-1.2, 0.95, 100), 15)
    table = compile_plant(true).measure(Table("r", "r.csv", t, {"source": steps}), 1)
    found = diagnose(loads(CLAMP), [table], {}, limits())
    assert found.decision.named == (("law", "v2"),)
    assert [p.form.name for p in found.law.proposal.terms] == ["exponential"]
    q = {k: found.law.fitted.plant.parameters[f"{k}1_law_v2"].value for k in ("A", "s", "Z")}
    assert q["s"] * q["Z"] == pytest.approx(0.052, rel=0.02)


SOLENOID = """
format: thermoctl-plant/1
title: A solenoid with a return spring; that its force falls with the gap is not in the model
inputs: {current: {unit: A}}
parameters:
  m: {value: 0.12, unit: kg}
  kf: {value: 8.0, unit: N/A^2, range: [2, 40]}
  k: {value: 1700, unit: N/m, range: [400, 6000]}
  c: {value: 7, unit: N*s/m, range: [0.2, 40]}
nodes:
  speed: {unit: m/s, storage: m, initial: 0}
  stroke: {unit: m, storage: 1, initial: 0}
flows:
  pull: {into: speed, rate: kf * current**2, unit: N}
  spring: {from: speed, rate: k * stroke, unit: N}
  oil: {from: speed, rate: c * speed, unit: N}
  travel: {into: stroke, rate: speed, unit: m/s}
outputs:
  lvdt: {value: stroke, unit: m, noise: 1.0e-5}
"""


def test_a_force_falls_with_the_square_of_a_gap():
    """An exponential was 700 nats worse, beside a false load."""
    true = loads(
        SOLENOID.replace("rate: kf * current**2,", 'rate: "kf * (current / (1 + stroke / 0.006))**2",')
    )
    t, rng = np.arange(0.0, 1.5, 1e-3), np.random.default_rng(8)
    inputs = {"current": np.repeat(rng.uniform(0.2, 1.6, 30), 50)}
    table = compile_plant(true).measure(Table("r", "r.csv", t, inputs), 4)
    found = diagnose(loads(SOLENOID), [table], {}, limits())
    assert found.decision.named == (("law", "speed"),)
    assert [p.form.name for p in found.law.proposal.terms] == ["gap_product"]
    q = {k: found.law.fitted.plant.parameters[f"{k}1_law_speed"].value for k in "kZ"}
    assert q["Z"] / q["k"] == pytest.approx(0.006, rel=0.02)
