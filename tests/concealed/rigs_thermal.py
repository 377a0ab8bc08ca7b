"""Three thermal families: the 12-node actuator, two heated blocks, an electric drive with winding voltage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from tests.concealed import sensors
from tests.concealed.rig import Scene, Suspect, clock, levels, off_centre, room
from tests.concealed.thermal import Network, Variant, simulate

HALF, TWO = (0.5, 2.0), (0.4, 2.5)


def _draw(belief: dict[str, tuple], rng: np.random.Generator) -> dict[str, float]:
    """The truth's parameter values, from {name: (value, unit, low, high)} or (value, unit)."""
    return {n: (off_centre(b[0], b[2], b[3], rng) if len(b) == 4 else b[0]) for n, b in belief.items()}


def _parameter_block(belief: dict[str, tuple]) -> dict:
    return {
        n: {"value": b[0], "unit": b[1], **({"range": [b[2], b[3]]} if len(b) == 4 else {})}
        for n, b in belief.items()
    }


def _network_block(
    net: Network, belief: dict[str, tuple], sigma: float, rates: dict[str, str]
) -> tuple[dict, dict]:
    """The `nodes` and `flows` of the plant file."""
    nodes = {
        n: {"unit": "degC", "storage": c, "initial": "air", "initial_sigma": sigma}
        for n, c in net.bodies.items()
    }
    flows = {q: {"into": body, "rate": rates[q], "unit": "W"} for q, (body, _) in net.joule.items()}
    for name, (g, a, b) in net.edges.items():
        if g in belief:
            ends = {"from": a} if b == "air" else {"from": a, "into": b}
            flows[name] = {**ends, "rate": f"{g} * ({a} - {b})", "unit": "W"}
    return nodes, flows


def _fault(rows: list[Variant], r: int, output: str, run: dict, y: np.ndarray, thermal: bool) -> np.ndarray:
    for effect, where, p in rows[r].effects:
        if where == output and effect in sensors.SENSOR_FAULTS:
            y = sensors.apply_fault(effect, p, run["t"], y, run["air"], run.get("position"), thermal)
    return y


def sensor_suspects(
    output: str,
    period: float,
    span: float,
    swing: float,
    air: bool,
    rng: np.random.Generator,
    top_value: float | None = None,
) -> list[Suspect]:
    """The sensor faults of an output whose signal swings by `swing`, sampled every `period`, over `span` seconds."""
    t0 = float(np.round(rng.uniform(0.25, 0.7) * span, 1))
    sign = rng.choice([-1, 1])
    found = [
        Suspect("sensor_lag", output, lambda s: {"TAU": 12 * period * s}, top=20),
        Suspect("sensor_delay", output, lambda s: {"TD": 10 * period * s}, top=20),
        Suspect("sensor_gain", output, lambda s: {"A": 1 - min(0.08 * s, 0.6)}, top=6),
        Suspect("sensor_offset_step", output, lambda s: {"A": sign * 0.05 * swing * s, "T0": t0}, onset="T0"),
        Suspect("sensor_drift", output, lambda s: {"A": sign * 0.05 * swing * s / span}),
    ]
    if air:
        found.append(Suspect("cold_junction_drift", output, lambda s: {"A": sign * 0.3 * s}, top=4))
    if top_value is not None:
        found.append(
            Suspect("sensor_saturation", output, lambda s: {"YMAX": top_value - swing * 0.08 * s}, top=4)
        )
    return found


def highest(outputs_of: Callable[[int, list[Variant]], np.ndarray], runs: int) -> np.ndarray:
    """Highest reading (ny,) of the truth with nothing missing: from there on a smaller limit is seen."""
    return np.max([outputs_of(k, [Variant()])[0].max(axis=0) for k in range(runs)], axis=0)


def thermal_suspects(
    net: Network,
    theta: dict,
    surfaces: list[str],
    films: list[str],
    joints: list[str],
    absent: list[tuple[str, str]],
    span: float,
    rise: float,
    pace: float,
    stroke: float,
    heat: float,
    rng: np.random.Generator,
) -> list[Suspect]:
    """The catalogue's heat effects at the places where they make sense on this network. `pace` and `stroke` are the
    recorded speed's and position's usual size, 0 where nothing moves."""
    t0 = float(np.round(rng.uniform(0.2, 0.45) * span))
    t1 = float(np.round(t0 + rng.uniform(0.15, 0.35) * span))
    sign = rng.choice([-1, 1])
    found: list[Suspect] = []
    film_of = {net.edges[f][1]: theta[net.edges[f][0]] for f in films}
    for n in surfaces:
        g, c = film_of.get(n, heat / rise / 4), theta[net.bodies[n]]
        found += [
            Suspect("radiation", n, lambda s, g=g: {"E": 0.4 * g / (4 * 295.0**3) * s}, top=20),
            Suspect("natural_convection", n, lambda s, g=g: {"G": 0.3 * g / rise**0.25 * s}, top=15),
            Suspect(
                "external_heat_source", n, lambda s: {"Q": 0.15 * heat * s, "T0": t0, "T1": t1}, onset="T0"
            ),
            Suspect("second_ambient", n, lambda s, g=g: {"G": 0.3 * g * s}, top=6),
            Suspect("hidden_thermal_mass", n, lambda s, g=g, c=c: {"C": 0.5 * c * s, "G": 1.2 * g}, top=8),
            Suspect("variable_heat_capacity", n, lambda s: {"A": 0.006 * s}, top=6),
        ]
        if pace:
            found += [
                Suspect("eddy_heating", n, lambda s: {"K": 0.2 * heat / pace**2 * s}),
                Suspect("hysteresis_heating", n, lambda s: {"K": 0.2 * heat / pace * s}),
            ]
    for f in films + joints:
        found.append(
            Suspect(
                "conductance_step",
                f,
                lambda s: {"A": -min(0.3 * s, 0.92) if sign < 0 else 0.4 * s, "T0": t0},
                onset="T0",
            )
        )
        found.append(Suspect("temperature_dependent_conductance", f, lambda s: {"A": 0.01 * s}, top=10))
        if pace:
            found.append(Suspect("forced_convection", f, lambda s: {"A": 0.4 / pace**0.5 * s}, top=8))
        if stroke:
            found.append(
                Suspect("position_dependent_conductance", f, lambda s: {"A": 0.17 / stroke * s}, top=5)
            )
    for a, b in absent:
        g = 0.3 * min(
            max((theta[p[0]] for p in net.edges.values() if n in p[1:]), default=1.0) for n in (a, b)
        )
        found.append(Suspect("missing_link", f"{a}-{b}", lambda s, g=g: {"G": g * s}))
    return found


def thermal_unknowns(
    surfaces: list[str], films: list[str], net: Network, rng: np.random.Generator
) -> list[Suspect]:
    """Heat effects that the catalogue lacks. Where: the node."""
    found = [Suspect("?melting", n, lambda s: {"A": 1.5 * s}, top=6) for n in surfaces]
    found += [Suspect("?boiling", n, lambda s: {"A": 0.15 * s}) for n in surfaces]
    return found + [Suspect("?fan", f, lambda s: {"A": 0.5 * s}, aliases=(net.edges[f][1],)) for f in films]


# --- the actuator --------------------------------------------------------------------------------
_NODES = {
    "coil": 42,
    "bobbin": 26,
    "inner_magnet": 64,
    "outer_magnet": 95,
    "inner_stator": 140,
    "outer_stator": 310,
    "stator_connector": 85,
    "bobbin_connector": 16,
    "shaft_1": 13,
    "shaft_2": 13,
    "bracket_1": 120,
    "bracket_2": 125,
}
_LINKS = {
    ("coil", "bobbin"): 1.1,
    ("bobbin", "inner_magnet"): 0.16,
    ("coil", "outer_magnet"): 0.13,
    ("inner_magnet", "inner_stator"): 1.4,
    ("outer_magnet", "outer_stator"): 1.6,
    ("inner_stator", "outer_stator"): 1.9,
    ("inner_stator", "stator_connector"): 0.8,
    ("bobbin", "bobbin_connector"): 0.27,
    ("bobbin_connector", "shaft_1"): 0.33,
    ("shaft_1", "shaft_2"): 0.17,
    ("stator_connector", "bracket_1"): 0.5,
    ("bracket_1", "bracket_2"): 0.42,
}
_FILMS = {
    "outer_stator": 0.34,
    "bracket_1": 0.15,
    "bracket_2": 0.2,
    "shaft_1": 0.02,
    "shaft_2": 0.035,
    "bobbin_connector": 0.02,
    "coil": 0.02,
}


FEW = 2  # volumes of an actuator's body where only differences are asked for: 24 modes in place of 72


class Actuator:
    """Flexure-based electromagnetic actuator: 12 bodies, up to 12 thermometers and the position error."""

    name = "actuator"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        belief: dict[str, tuple] = {f"C_{n}": (c, "J/K", c * 0.5, c * 2.0) for n, c in _NODES.items()}
        belief |= {f"G_{a}_{b}": (g, "W/K", g * 0.4, g * 2.5) for (a, b), g in _LINKS.items()}
        belief |= {f"H_{n}": (h, "W/K", h * 0.2, h * 3.0) for n, h in _FILMS.items()}
        belief |= {
            "a_shaft": (0.42, "um/K", 0.1, 1.0),
            "a_bobbin": (0.25, "um/K", 0.05, 0.8),
            "a_stator": (-0.2, "um/K", -0.8, 0.0),
            "T_ref": (22.0, "degC"),
        }
        theta = _draw(belief, rng)
        edges = {f"{a}_to_{b}": (f"G_{a}_{b}", a, b) for a, b in _LINKS}
        edges |= {f"{n}_to_air": (f"H_{n}", n, "air") for n in _FILMS}
        net = Network({n: f"C_{n}" for n in _NODES}, edges, {"joule": ("coil", "vi")})
        runs = []
        n, period = (3600 if short else 7200), 2.0
        for _ in range(2):
            t = clock(n, period, rng)
            current = levels(t, rng, schedule, 0.95, 900.0)
            busy = current > 0
            stroke = 2 * np.pi * t / rng.uniform(150, 400)
            position = 1.4 * np.sin(stroke) * busy if schedule != "warm-up" else np.where(busy, 0.8, 0.0)
            pace = np.interp(t, np.linspace(0, t[-1], 12), rng.choice([0.0, 0.03, 0.06, 0.12], 12))
            velocity = pace * np.sign(np.cos(stroke)) * busy if schedule != "warm-up" else 0.02 * busy
            voltage = current * rng.uniform(4.9, 5.4)
            run = {
                "t": t,
                "air": room(t, rng, 0.7),
                "current": np.round(current, 7),
                "voltage": np.round(voltage, 7),
                "position": np.round(position, 6),
                "velocity": np.round(velocity, 6),
                "melt_at": 26.0,
            }
            run["heat:joule"] = run["voltage"] * run["current"]
            run["base"] = run["air"] + 3 * np.sin(
                2 * np.pi * t / t[-1] * rng.uniform(0.6, 1.6) + rng.uniform(0, 6)
            )
            run["start"] = rng.normal(0, 0.08, 12)
            runs.append(run)
        full = rng.random() < 0.5
        seen = (
            list(_NODES)
            if full
            else ["coil", "bobbin", "outer_stator", "bracket_2"]
            + list(
                rng.choice(
                    ["outer_magnet", "inner_stator", "stator_connector", "shaft_1", "bracket_1"],
                    2,
                    replace=False,
                )
            )
        )
        outputs = [f"{b}_temperature" for b in seen] + ["position_error"]
        nodes, flows = _network_block(net, belief, 0.2, {"joule": "voltage * current"})
        expansion = (
            "a_shaft * (shaft_1 + shaft_2 - 2 * T_ref) + a_bobbin * (bobbin - T_ref) + a_stator * "
            "(outer_stator - T_ref)"
        )
        plant = {
            "format": "thermoctl-plant/1",
            "title": "Flexure-based linear electromagnetic actuator, thermal",
            "inputs": {
                "voltage": {"unit": "V"},
                "current": {"unit": "A"},
                "air": {"unit": "degC", "column": "air_temperature", "between_samples": "linear"},
            },
            "parameters": _parameter_block(belief),
            "nodes": nodes,
            "flows": flows,
            "outputs": {f"{b}_temperature": {"value": b, "unit": "degC", "noise": 0.06} for b in seen}
            | {"position_error": {"value": expansion, "unit": "um", "noise": 0.05}},
        }
        at = {b: i for i, b in enumerate(_NODES)}

        def outputs_of(k: int, rows: list[Variant], net: Network = net) -> np.ndarray:
            run = runs[k]
            temps = simulate(net, theta, run, rows)
            out = np.empty((len(rows), len(run["t"]), len(outputs)))
            for r, row in enumerate(rows):
                p = {**theta, **row.theta}
                node = {b: temps[r, :, i] for b, i in at.items()}
                for j, b in enumerate(seen):
                    out[r, :, j] = _fault(rows, r, outputs[j], run, node[b], True)
                y = (
                    p["a_shaft"] * (node["shaft_1"] + node["shaft_2"] - 2 * p["T_ref"])
                    + p["a_bobbin"] * (node["bobbin"] - p["T_ref"])
                    + p["a_stator"] * (node["outer_stator"] - p["T_ref"])
                )
                for effect, where, q in row.effects:
                    if effect == "missing_member":
                        y = y + q["A"] * (node[where] - node[where][0])
                    elif effect == "quadratic_expansion":
                        y = y + q["A"] * (node["bobbin"] - 20) ** 2
                    elif effect == "scale_expansion":
                        y = y + q["A"] * run["position"] * (node["outer_stator"] - 20)
                    elif effect == "bending":
                        one, other = where.split("-")
                        y = y + q["A"] * (node[one] - node[other])
                    elif effect == "expansion_lag":
                        y = sensors.lag(run["t"], y, q["TAU"])
                    elif (
                        effect == "?output_memory"
                    ):  # a joint that slips when the growth passes a limit and stays
                        y = y + q["A"] * np.maximum.accumulate(np.floor(np.maximum(y - y[0], 0) / 2.0))
                out[r, :, -1] = _fault(rows, r, "position_error", run, y, False)
            return out

        span, moving = runs[0]["t"][-1], schedule != "warm-up"
        suspects = thermal_suspects(
            net,
            theta,
            ["outer_stator", "bracket_1", "bracket_2", "inner_stator", "outer_magnet", "bobbin"],
            ["outer_stator_to_air", "bracket_1_to_air", "bracket_2_to_air"],
            [
                "coil_to_bobbin",
                "inner_stator_to_outer_stator",
                "stator_connector_to_bracket_1",
                "coil_to_outer_magnet",
                "bobbin_to_bobbin_connector",
            ],
            [
                ("outer_stator", "bracket_2"),
                ("outer_magnet", "inner_stator"),
                ("bobbin", "bracket_1"),
                ("coil", "inner_stator"),
            ],
            span,
            4.0,
            0.1 * moving,
            1.4 * moving,
            4.0,
            rng,
        )
        for b in ("bobbin", "outer_magnet", "inner_stator"):
            suspects.append(Suspect("heat_split", f"coil-{b}", lambda s: {"A": min(0.12 * s, 0.8)}))
        for output in outputs[:8]:
            suspects += sensor_suspects(output, period, span, 5.0, True, rng)
        suspects += [
            x
            for x in sensor_suspects("position_error", period, span, 4.0, False, rng)
            if x.effect in ("sensor_offset_step", "sensor_drift")
        ]
        suspects += [
            Suspect("missing_member", b, lambda s: {"A": 0.15 * s})
            for b in ("bracket_1", "bracket_2", "inner_stator", "stator_connector", "outer_magnet")
        ]
        suspects += [
            Suspect("bending", f"{a}-{b}", lambda s: {"A": 0.15 * s})
            for a, b in (
                ("outer_stator", "bracket_2"),
                ("inner_stator", "outer_magnet"),
                ("bracket_1", "bracket_2"),
            )
        ]
        suspects += [
            Suspect("quadratic_expansion", "position_error", lambda s: {"A": 0.006 * s}),
            Suspect("expansion_lag", "position_error", lambda s: {"TAU": 60 * s}),
        ]
        if schedule != "warm-up":
            suspects.append(Suspect("scale_expansion", "position_error", lambda s: {"A": 0.03 * s}))
        unknowns = thermal_unknowns(
            ["bobbin", "outer_stator"], ["outer_stator_to_air", "bracket_1_to_air"], net, rng
        )
        unknowns.append(Suspect("?output_memory", "position_error", lambda s: {"A": 0.1 * s}))
        columns = {n: n for n in ("current", "voltage", "position", "velocity")} | {"air_temperature": "air"}
        rough_of = partial(outputs_of, net=replace(net, cells=FEW))
        return Scene.of(plant, theta, runs, columns, outputs_of, suspects, unknowns, rough_of)


# --- two heated blocks --------------------------------------------------------------------------------
class Heater:
    """Two heated blocks side by side, or three in a row, each with a thermometer."""

    name = "heater"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        three = rng.random() < 0.35
        count = 3 if three else 2
        scale = rng.uniform(0.7, 1.5)
        ids = range(1, count + 1)
        belief: dict[str, tuple] = {
            f"C_{i}": (round(6.0 * scale, 2), "J/K", 2.0 * scale, 14 * scale) for i in ids
        }
        belief |= {f"G_{i}": (0.05, "W/K", 0.015, 0.15) for i in ids}
        linked = rng.random() < 0.75
        edges = {f"loss_{i}": (f"G_{i}", f"block_{i}", "air") for i in ids}
        if linked or three:
            belief["G_12"] = (0.02, "W/K", 0.004, 0.08)
            edges["between"] = ("G_12", "block_1", "block_2")
        if three:
            belief["G_23"] = (0.03, "W/K", 0.006, 0.1)
            edges["between_23"] = ("G_23", "block_2", "block_3")
        theta = _draw(belief, rng)
        heated = [1, 2]
        net = Network(
            {f"block_{i}": f"C_{i}" for i in ids},
            edges,
            {f"power_{i}": (f"block_{i}", "power") for i in heated},
            cells=20,
        )
        runs = []
        for _ in range(2):
            t = clock(2400 if short else 3600, 1.0, rng)
            run: dict = {"t": t, "air": room(t, rng, 0.8), "melt_at": 38.0}
            for i in heated:
                run[f"heat_{i}"] = np.round(levels(t, rng, schedule, 2.2 * scale, 320.0, 0.15), 4)
                run[f"heat:power_{i}"] = run[f"heat_{i}"]
            run["base"] = run["air"] + 6 * np.sin(
                2 * np.pi * t / t[-1] * rng.uniform(0.6, 1.6) + rng.uniform(0, 6)
            )
            run["start"] = rng.normal(0, 0.2, count)
            runs.append(run)
        coarse = rng.random() < 0.3
        nodes, flows = _network_block(net, belief, 0.5, {f"power_{i}": f"heat_{i}" for i in heated})
        outputs = [f"temperature_{i}" for i in ids]
        noise = 0.1
        plant = {
            "format": "thermoctl-plant/1",
            "title": f"{'Three' if three else 'Two'} heated blocks side by side",
            "inputs": {f"heat_{i}": {"unit": "W"} for i in heated}
            | {"air": {"unit": "degC", "column": "air_temperature", "between_samples": "linear"}},
            "parameters": _parameter_block(belief),
            "nodes": nodes,
            "flows": flows,
            "outputs": {
                f"temperature_{i}": {"value": f"block_{i}", "unit": "degC", "noise": noise}
                | ({"resolution": 0.1} if coarse else {})
                for i in ids
            },
        }

        def outputs_of(k: int, rows: list[Variant]) -> np.ndarray:
            temps = simulate(net, theta, runs[k], rows)
            for r in range(len(rows)):
                for j, output in enumerate(outputs):
                    temps[r, :, j] = _fault(rows, r, output, runs[k], temps[r, :, j], True)
            return temps

        span = runs[0]["t"][-1]
        blocks = list(net.bodies)
        joints = [f for f in edges if f.startswith("between")]
        absent = [] if joints else [("block_1", "block_2")]
        if three:
            absent.append(("block_1", "block_3"))
        suspects = thermal_suspects(
            net,
            theta,
            blocks,
            [f"loss_{i}" for i in ids],
            joints,
            absent,
            span,
            20.0,
            0.0,
            0.0,
            2.2 * scale,
            rng,
        )
        peaks = highest(outputs_of, len(runs))
        suspects.append(Suspect("heat_split", "block_1-block_2", lambda s: {"A": min(0.08 * s, 0.7)}))
        suspects.append(Suspect("heat_split", "block_2-block_1", lambda s: {"A": min(0.08 * s, 0.7)}))
        for i in ids:
            suspects += sensor_suspects(
                f"temperature_{i}", 1.0, span, 20.0, True, rng, top_value=(peaks[i - 1] if i < 3 else None)
            )
        unknowns = thermal_unknowns(blocks[:2], ["loss_1", "loss_2"], net, rng)
        columns = {f"heat_{i}": f"heat_{i}" for i in heated} | {"air_temperature": "air"}
        return Scene.of(plant, theta, runs, columns, outputs_of, suspects, unknowns)


# --- an electric drive --------------------------------------------------------------------------------
class Drive:
    """A servo motor: current and speed recorded, winding voltage, winding and housing temperature read."""

    name = "drive"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        known_resistance = 1.2
        knows = {e: rng.random() < 0.6 for e in ("copper_resistance", "resistance_temperature", "back_emf")}
        belief: dict[str, tuple] = {
            "C_winding": (60.0, "J/K", 25, 150),
            "C_housing": (320.0, "J/K", 120, 800),
            "C_flange": (500.0, "J/K", 200, 1200),
            "G_winding": (1.4, "W/K", 0.5, 4),
            "G_flange": (1.1, "W/K", 0.4, 3),
            "H_housing": (0.8, "W/K", 0.25, 2.4),
            "H_flange": (1.0, "W/K", 0.3, 3),
            "R_w": (known_resistance, "ohm", 0.8, 1.8),
        }
        if knows["back_emf"]:
            belief["K_e"] = (0.11, "V*s/rad", 0.05, 0.25)
        theta = _draw(belief, rng)
        edges = {
            "winding_to_housing": ("G_winding", "winding", "housing"),
            "housing_to_flange": ("G_flange", "housing", "flange"),
            "housing_to_air": ("H_housing", "housing", "air"),
            "flange_to_air": ("H_flange", "flange", "air"),
        }
        net = Network(
            {b: f"C_{b}" for b in ("winding", "housing", "flange")},
            edges,
            {"joule": ("winding", "i2r")},
            cells=12,
        )
        runs = []
        for _ in range(2):
            t = clock(2400 if short else 3600, 2.0, rng)
            hold = vigour * levels(t, rng, schedule, 5.0, 500.0)
            wave = 1 + (0.25 * np.sin(2 * np.pi * t / rng.uniform(30, 90)) if schedule != "warm-up" else 0)
            current = np.round(hold * wave, 5)
            pace = np.interp(
                t, np.linspace(0, t[-1], 25), rng.choice([0.0, 20.0, 60.0, 100.0], 25)
            ) * rng.choice([-1, 1])
            speed = np.round((pace if schedule != "warm-up" else np.full(len(t), 40.0)) * (hold > 0), 5)
            runs.append(
                {
                    "t": t,
                    "air": room(t, rng, 1.0),
                    "current": current,
                    "velocity": speed,
                    "speed": speed,
                    "melt_at": 45.0,
                    "start": rng.normal(0, 0.1, 3),
                    "base": 24
                    + 5 * np.sin(2 * np.pi * t / t[-1] * rng.uniform(0.6, 1.6) + rng.uniform(0, 6)),
                }
            )
        grow = " * (1 + 0.00393 * (winding - 20))"
        nodes, flows = _network_block(
            net, belief, 0.3, {"joule": "R_w * current**2" + (grow if knows["copper_resistance"] else "")}
        )
        volts = (
            "R_w * current"
            + (grow if knows["resistance_temperature"] else "")
            + (" + K_e * speed" if knows["back_emf"] else "")
        )
        housing_seen = rng.random() < 0.8
        outputs = (
            ["winding_temperature"] + (["housing_temperature"] if housing_seen else []) + ["winding_voltage"]
        )
        spec = {
            "winding_temperature": {"value": "winding", "unit": "degC", "noise": 0.15},
            "housing_temperature": {"value": "housing", "unit": "degC", "noise": 0.1},
            "winding_voltage": {"value": volts, "unit": "V", "noise": 0.02},
        }
        plant = {
            "format": "thermoctl-plant/1",
            "title": "Servo motor, winding, housing and flange",
            "inputs": {"current": {"unit": "A"}}
            | ({"speed": {"unit": "rad/s"}} if knows["back_emf"] else {})
            | {"air": {"unit": "degC", "column": "air_temperature", "between_samples": "linear"}},
            "parameters": _parameter_block(belief),
            "nodes": nodes,
            "flows": flows,
            "outputs": {o: spec[o] for o in outputs},
        }

        def outputs_of(k: int, rows: list[Variant]) -> np.ndarray:
            run = runs[k]
            rows = [
                Variant(
                    {**row.theta, "scale:joule": row.theta.get("R_w", theta["R_w"])},
                    row.start,
                    row.effects
                    + ([("copper_resistance", "joule", {})] if knows["copper_resistance"] else []),
                )
                for row in rows
            ]
            run["heat:joule"] = run["current"] ** 2
            temps = simulate(net, theta, run, rows)
            out = np.empty((len(rows), len(run["t"]), len(outputs)))
            for r, row in enumerate(rows):
                p = {**theta, **row.theta}
                present = {e: q for e, _, q in row.effects}
                ohm = p["R_w"] * np.ones(len(run["t"]))
                if knows["resistance_temperature"] or "resistance_temperature" in present:
                    ohm = ohm * (
                        1
                        + 0.00393
                        * (temps[r, :, 0] - 20)
                        * present.get("resistance_temperature", {}).get("share", 1)
                    )
                y = {
                    "winding_temperature": temps[r, :, 0],
                    "housing_temperature": temps[r, :, 1],
                    "winding_voltage": ohm * run["current"],
                }
                if knows["back_emf"]:
                    y["winding_voltage"] = y["winding_voltage"] + p["K_e"] * run["speed"]
                if "back_emf" in present:
                    y["winding_voltage"] = y["winding_voltage"] + present["back_emf"]["K"] * run["speed"]
                if "?output_memory" in present:  # contact resistance that jumps while hot: brushes
                    y["winding_voltage"] = y["winding_voltage"] + present["?output_memory"]["A"] * np.sign(
                        run["current"]
                    ) * (np.sin(run["t"] / 37.0) * np.sin(run["t"] / 11.3) > 0.4)
                for j, output in enumerate(outputs):
                    out[r, :, j] = _fault(rows, r, output, run, y[output], output != "winding_voltage")
            return out

        span = runs[0]["t"][-1]
        suspects = thermal_suspects(
            net,
            theta,
            ["housing", "flange"],
            ["housing_to_air", "flange_to_air"],
            ["winding_to_housing", "housing_to_flange"],
            [("winding", "flange")],
            span,
            15.0,
            80.0 * (schedule != "warm-up"),
            0.0,
            20.0,
            rng,
        )
        peaks = highest(outputs_of, len(runs))
        suspects.append(Suspect("heat_split", "winding-housing", lambda s: {"A": min(0.1 * s, 0.7)}))
        suspects.append(Suspect("hidden_thermal_mass", "winding", lambda s: {"C": 40.0 * s, "G": 1.0}))
        if not knows["copper_resistance"]:
            suspects.append(Suspect("copper_resistance", "joule", lambda s: {"A": 0.00393}, top=1))
        if not knows["resistance_temperature"]:
            suspects.append(
                Suspect("resistance_temperature", "winding_voltage", lambda s: {"A": 0.00393}, top=1)
            )
        if not knows["back_emf"]:
            suspects.append(Suspect("back_emf", "winding_voltage", lambda s: {"K": 0.01 * s}))
        for output in outputs:
            hot = output != "winding_voltage"
            suspects += [
                x
                for x in sensor_suspects(
                    output, 2.0, span, 15.0 if hot else 5.0, hot, rng, top_value=(None if hot else peaks[-1])
                )
                if hot or x.effect != "sensor_gain"
            ]
        unknowns = thermal_unknowns(["housing"], ["housing_to_air"], net, rng)
        unknowns.append(Suspect("?output_memory", "winding_voltage", lambda s: {"A": 0.05 * s}))
        columns = {"current": "current", "speed": "speed", "air_temperature": "air"}
        return Scene.of(plant, theta, runs, columns, outputs_of, suspects, unknowns)
