"""Two motion families, integrated by splitting: a free linear stage, and a flexure stage with coil heat and voltage.

One substep h: half a step of position, a whole step of velocity with the smooth forces held at the midpoint (exact for
the linear damper), the Coulomb force as a set-valued law (the velocity is held at zero when the dry friction can hold
it, else the exact impulse is taken off, never through zero), half a step of position. Memory forces (Bouc-Wen, Maxwell)
take exact or midpoint steps. Four substeps a sample or more; many variants (rows) go through together as columns of numbers.
The loop over samples and substeps is compiled (loops.pyx); march_in_python is the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.concealed.compiled import loops
from tests.concealed.rig import Scene, Suspect, clock, levels, room
from tests.concealed.rigs_thermal import _draw, _fault, _parameter_block, sensor_suspects
from tests.concealed.thermal import Variant

SUBSTEPS = 4  # a sample; a rig with a resonance asks for more by run["substeps"]

# effect parameters as columns of numbers; the value is the neutral one
_NEUTRAL = {
    "viscous_friction.B": 0.0,
    "coulomb_friction.F": 0.0,
    "stribeck_friction.FC": 0.0,
    "stribeck_friction.FS": 0.0,
    "stribeck_friction.VS": 1.0,
    "directional_friction.FP": 0.0,
    "directional_friction.FM": 0.0,
    "directional_friction.BP": 0.0,
    "directional_friction.BM": 0.0,
    "constant_load.F": 0.0,
    "quadratic_drag.B": 0.0,
    "cubic_stiffness.K": 0.0,
    "cogging.A": 0.0,
    "cogging.P": 1.0,
    "cogging.PHI": 0.0,
    "backlash_hysteresis.F": 0.0,
    "backlash_hysteresis.X": 1.0,
    "creep.K": 0.0,
    "creep.TAU": 1.0,
    "force_constant_temperature.B": 0.0,
    "position_dependent_force_constant.A": 0.0,
    "actuator_saturation.U": 1e9,
    "actuator_dead_zone.U": 0.0,
    "actuator_delay.TD": 0.0,
    "?sticky_zone.F": 0.0,
    "?sticky_zone.X": 0.0,
    "?second_mass.K": 0.0,
    "?second_mass.M": 1.0,
    "?one_way_gain.A": 0.0,
}


def columns(rows: list[Variant]) -> dict[str, np.ndarray]:
    """Every effect parameter as an array (m,)."""
    out = {k: np.full(len(rows), v) for k, v in _NEUTRAL.items()}
    for r, row in enumerate(rows):
        for effect, _, p in row.effects:
            for name, value in p.items():
                if f"{effect}.{name}" in out:
                    out[f"{effect}.{name}"][r] = value
    return out


_DRY = (
    "coulomb_friction.F",
    "stribeck_friction.FC",
    "stribeck_friction.FS",
    "directional_friction.FP",
    "directional_friction.FM",
    "?sticky_zone.F",
)
States = dict[str, np.ndarray]


def simulate(theta: dict, run: dict, rows: list[Variant]) -> States:
    """Position m, velocity m/s, coil temperature degC, each (m, N). `theta`: gain N/V or N/A, mass, damping, stiffness,
    and for a heated coil R, C_coil, G_coil."""
    full = [{**theta, **row.theta} for row in rows]
    defaults = dict.fromkeys(("gain", "mass", "damping", "stiffness", "R", "G_coil"), 0.0) | {"C_coil": 1.0}
    p = {name: np.array([float(x.get(name, v)) for x in full]) for name, v in defaults.items()}
    p["copper"] = np.array(
        [
            float(any(x == "copper_resistance" for x, _, _ in row.effects) or theta.get("knows_copper", 0))
            for row in rows
        ]
    )
    p["start"] = np.array([row.start.get("position", 0.0) for row in rows]) + run.get("start", 0.0)
    p["start_coil"] = (
        np.full(len(rows), run["air"][0])
        + np.array([row.start.get("coil", 0.0) for row in rows])
        + run.get("start_coil", 0.0)
    )
    whole = {
        **run,
        "substeps": run.get("substeps", SUBSTEPS),
        "held": bool(run.get("held")),  # input holds between samples, else straight lines
        "area": np.concatenate([[0.0], np.cumsum(run["drive"][:-1] * np.diff(run["t"]))]),
    }
    return march(p, columns(rows), whole, "C_coil" in theta)


def march_compiled(p: States, e: States, run: dict, heated: bool) -> States:
    """All rows through the compiled loop. `p` parameters and starts, `e` effect parameters, by name (m,)."""
    out = {k: np.empty((len(p["gain"]), len(run["t"]))) for k in ("position", "velocity", "coil")}
    dry = any(np.any(e[k] != _NEUTRAL[k]) for k in _DRY)
    loops.motion(p, e, run, heated, dry, bool(np.any(e["actuator_delay.TD"])), **out)
    return out


def march_in_python(p: States, e: States, run: dict, heated: bool) -> States:
    """The same as march_compiled: what it is compared with, and what tells how it goes."""
    m, t, u, air = len(p["gain"]), run["t"], run["drive"], run["air"]
    gain, mass, damping, stiffness = (p[k] for k in ("gain", "mass", "damping", "stiffness"))
    ohm, heat_c, heat_g, copper = (p[k] for k in ("R", "C_coil", "G_coil", "copper"))
    on = {k: bool(np.any(v != _NEUTRAL[k])) for k, v in e.items()}
    dry = any(on[k] for k in _DRY)
    x, v, coil = p["start"], np.zeros(m), p["start_coil"]
    rest = x.copy()  # creep: position of the damper in series
    bouc = np.zeros(m)
    x2, v2 = x.copy(), np.zeros(m)
    substeps, stays = run["substeps"], run["held"]
    out = {k: np.empty((m, len(t))) for k in ("position", "velocity", "coil")}
    delayed = on["actuator_delay.TD"]
    late = _delayed(run, stays)
    for k in range(len(t)):
        out["position"][:, k], out["velocity"][:, k], out["coil"][:, k] = x, v, coil
        if k == len(t) - 1:
            break
        h = (t[k + 1] - t[k]) / substeps
        decay_rate = damping + e["viscous_friction.B"]
        for s in range(substeps):
            x = x + v * (h / 2)
            if delayed:
                begin = t[k] + s * h - e["actuator_delay.TD"]
                drive = late(begin, begin + h)
            else:
                drive = np.full(m, u[k] if stays else u[k] + (u[k + 1] - u[k]) * (s + 0.5) / substeps)
            sent = drive
            if on["actuator_saturation.U"]:
                sent = np.clip(sent, -e["actuator_saturation.U"], e["actuator_saturation.U"])
            if on["actuator_dead_zone.U"]:
                sent = np.where(np.abs(sent) < e["actuator_dead_zone.U"], 0.0, sent)
            if on["?one_way_gain.A"]:
                sent = sent * (1 + e["?one_way_gain.A"] * (sent * v > 0))
            k_motor = gain
            if on["force_constant_temperature.B"]:
                k_motor = k_motor * (1 - e["force_constant_temperature.B"] * (coil - 20))
            if on["position_dependent_force_constant.A"]:
                k_motor = k_motor * (1 - e["position_dependent_force_constant.A"] * x**2)
            force = k_motor * sent - stiffness * x - e["constant_load.F"]
            if on["cubic_stiffness.K"]:
                force = force - e["cubic_stiffness.K"] * x**3
            if on["cogging.A"]:
                force = force + e["cogging.A"] * np.sin(2 * np.pi * x / e["cogging.P"] + e["cogging.PHI"])
            if on["quadratic_drag.B"]:
                force = force - e["quadratic_drag.B"] * v * np.abs(v)
            if on["backlash_hysteresis.F"]:  # Bouc-Wen, n = 1: dz = (v - |v| z sign(v z)...) / X, midpoint
                half = bouc + (v - 0.5 * (np.abs(v) * bouc + v * np.abs(bouc))) / e[
                    "backlash_hysteresis.X"
                ] * (h / 2)
                bouc = (
                    bouc + (v - 0.5 * (np.abs(v) * half + v * np.abs(half))) / e["backlash_hysteresis.X"] * h
                )
                force = force - e["backlash_hysteresis.F"] * bouc
            if on["creep.K"]:
                rest = x + (rest - x) * np.exp(-h / e["creep.TAU"])
                force = force - e["creep.K"] * (x - rest)
            if on["?second_mass.K"]:
                pull = e["?second_mass.K"] * (x2 - x) + 0.02 * np.sqrt(
                    e["?second_mass.K"] * e["?second_mass.M"]
                ) * (v2 - v)
                v2 = v2 - pull / e["?second_mass.M"] * h
                x2 = x2 + v2 * h
                force = force + pull
            rate = decay_rate
            if on["directional_friction.BP"] or on["directional_friction.BM"]:
                rate = rate + np.where(v > 0, e["directional_friction.BP"], e["directional_friction.BM"])
            free = np.exp(-rate * h / mass)
            push = np.where(rate > 1e-9, (1 - free) / np.maximum(rate, 1e-9), h / mass)
            new = v * free + push * force
            if dry:
                limit = (
                    e["coulomb_friction.F"]
                    + e["stribeck_friction.FC"]
                    + e["stribeck_friction.FS"] * np.exp(-((v / e["stribeck_friction.VS"]) ** 2))
                    + np.where(new > 0, e["directional_friction.FP"], e["directional_friction.FM"])
                    + e["?sticky_zone.F"] * (x > e["?sticky_zone.X"])
                )
                new = np.sign(new) * np.maximum(np.abs(new) - push * limit, 0.0)
            v = new
            x = x + v * (h / 2)
            if heated:
                watts = ohm * drive**2 * (1 + 0.00393 * (coil - 20) * copper)
                room_now = air[k] + (air[k + 1] - air[k]) * (s + 0.5) / substeps
                settle = room_now + watts / heat_g
                coil = settle + (coil - settle) * np.exp(-heat_g / heat_c * h)
    return out


march = march_compiled


def _delayed(run: dict, held: bool) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Mean of the drive between two times (m,), each row's own; exact where it is held, else that of the middle."""
    t, u = run["t"], run["drive"]
    if not held:
        return lambda begin, end: np.interp((begin + end) / 2, t, u)

    def until(when: np.ndarray) -> np.ndarray:
        return np.interp(when, t, run["area"]) + u[0] * np.minimum(when - t[0], 0.0)

    return lambda begin, end: (until(end) - until(begin)) / (end - begin)


def friction_suspects(force: float, pace: float, travel: float) -> list[Suspect]:
    """Friction and force effects at the node `velocity`; `force` N, `pace` m/s and `travel` m are usual sizes."""
    f = 0.12 * force
    return [
        Suspect("coulomb_friction", "velocity", lambda s: {"F": f * s}, top=4),
        Suspect(
            "stribeck_friction",
            "velocity",
            lambda s: {"FC": f * s, "FS": 0.6 * f * s, "VS": 0.15 * pace},
            top=4,
        ),
        Suspect(
            "directional_friction",
            "velocity",
            lambda s: {"FP": f * s, "FM": 1.6 * f * s, "BP": 0.05 * f / pace * s, "BM": 0.4 * f / pace * s},
            top=4,
        ),
        Suspect("constant_load", "velocity", lambda s: {"F": 0.5 * f * s}, top=6),
        Suspect("quadratic_drag", "velocity", lambda s: {"B": 2 * f / pace**2 * s}, top=10),
        Suspect("cogging", "velocity", lambda s: {"A": f * s, "P": travel * 0.13, "PHI": 0.7}, top=6),
        Suspect("backlash_hysteresis", "velocity", lambda s: {"F": f * s, "X": 0.02 * travel}, top=5),
        Suspect("cubic_stiffness", "velocity", lambda s: {"K": f / travel**3 * s}, top=10),
    ]


def drive_suspects(drive: float, runs: list[dict], period: float, travel: float) -> list[Suspect]:
    """Faults of the motor and its amplifier at the flow `motor`; `drive` is the usual input, in `runs` it is recorded."""
    peak = max(float(np.abs(run["drive"]).max()) for run in runs)
    return [
        Suspect("actuator_saturation", "motor", lambda s: {"U": peak * max(1 - 0.25 * s, 0.3)}, top=3),
        Suspect("actuator_dead_zone", "motor", lambda s: {"U": 0.08 * drive * s}, top=5),
        Suspect("actuator_delay", "motor", lambda s: {"TD": 4 * period * s}, top=5),
        Suspect("position_dependent_force_constant", "motor", lambda s: {"A": 0.2 / travel**2 * s}, top=3),
    ]


class FreeStage:
    """A linear stage with a free carriage, drive voltage in, encoder out."""

    name = "stage"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        size = float(np.round(rng.uniform(0.3, 1.5), 2))
        damped = rng.random() < 0.8
        belief: dict[str, tuple] = {
            "gain": (32.0 * size, "N/V"),
            "mass": (90.0 * size, "kg", 40 * size, 160 * size),
        }
        if damped:
            belief["damping"] = (200.0 * size, "N*s/m", 20 * size, 800 * size)
        theta = _draw(belief, rng)
        n, period = (4000 if short else 8000), 0.0025
        runs = []
        for _ in range(2):
            t = clock(n, period, rng)
            drive = np.zeros(n)
            now, at = (0.8 if schedule == "warm-up" else rng.uniform(0, 0.5)), 0.0
            limit = 0.4
            while now < t[-1]:
                length = rng.uniform(0.4, 1.6) * (2 if schedule == "warm-up" else 1)
                push = {
                    "warm-up": 1.4,
                    "production-like": rng.choice([1.2, 1.5, 0.0]),
                    "designed": rng.uniform(0, 2.0),
                }[schedule]
                sign = -np.sign(at) if abs(at) > limit else rng.choice([-1, 1])
                drive[(t >= now) & (t < now + length)] = push * sign
                at += push * sign * length * 0.15
                now += length
            runs.append(
                {
                    "t": t,
                    "drive": np.round(drive, 6),
                    "held": True,
                    "air": np.full(n, 22.0),
                    "start": rng.normal(0, 3e-4),
                }
            )
        lost = "" if damped else " without a damper"
        flows = {"motor": {"into": "velocity", "rate": "gain * drive", "unit": "N"}}
        if damped:
            flows["damper"] = {"from": "velocity", "rate": "damping * velocity", "unit": "N"}
        flows["travel"] = {"into": "position", "rate": "velocity", "unit": "m/s"}
        fine = rng.random() < 0.5
        noise = 0.02 if not fine else 0.005
        plant = {
            "format": "thermoctl-plant/1",
            "title": f"Linear stage with a free carriage{lost}",
            "inputs": {"drive": {"unit": "V"}},
            "parameters": _parameter_block(belief),
            "nodes": {
                "velocity": {"unit": "m/s", "storage": "mass", "initial": 0},
                "position": {"unit": "m", "storage": 1, "initial": 0, "initial_sigma": 0.001},
            },
            "flows": flows,
            "outputs": {
                "encoder": {"value": "position * 1e3", "unit": "mm", "noise": noise}
                | ({"resolution": 0.01} if fine else {})
            },
        }

        def outputs_of(k: int, rows: list[Variant]) -> np.ndarray:
            with np.errstate(
                over="ignore", invalid="ignore"
            ):  # a rival too large for the rig: its row is not finite
                states = simulate(theta, runs[k], rows)
            out = np.empty((len(rows), n, 1))
            for r in range(len(rows)):
                run = runs[k] | {"position": states["position"][r]}
                out[r, :, 0] = _fault(rows, r, "encoder", run, 1e3 * states["position"][r], False)
            return out

        pace, travel, force = 0.15, 0.3, 32 * size * 1.2
        suspects = friction_suspects(force, pace, travel) + drive_suspects(1.5, runs, period, travel)
        if not damped:
            suspects = [s for s in suspects if s.effect not in ("directional_friction", "stribeck_friction")]
            suspects.append(Suspect("viscous_friction", "velocity", lambda s: {"B": 60 * size * s}))
        faults = sensor_suspects("encoder", period, runs[0]["t"][-1], 100.0, False, rng)
        suspects += [
            s
            for s in faults
            if s.effect in ("sensor_lag", "sensor_delay", "sensor_offset_step", "sensor_drift")
        ]
        suspects.append(Suspect("cyclic_error", "encoder", lambda s: {"A": 0.05 * s, "P": 0.02, "PHI": 0.4}))
        unknowns = [
            Suspect("?sticky_zone", "velocity", lambda s: {"F": 0.2 * force * s, "X": 0.02}, top=4),
            Suspect(
                "?second_mass", "velocity", lambda s: {"M": 12 * size * s, "K": 12 * size * s * 900}, top=3
            ),
            Suspect("?one_way_gain", "motor", lambda s: {"A": 0.12 * s}, top=4, aliases=("velocity",)),
        ]
        return Scene.of(plant, theta, runs, {"drive": "drive"}, outputs_of, suspects, unknowns)


class Flexure:
    """A voice-coil stage on flexures: current in; position, winding voltage and coil temperature out."""

    name = "flexure"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        knows = {
            e: bool(rng.random() < 0.65)
            for e in ("back_emf", "inductance", "resistance_temperature", "copper_resistance")
        }
        belief: dict[str, tuple] = {
            "gain": (9.0, "N/A"),
            "mass": (0.6, "kg", 0.3, 1.2),
            "stiffness": (900.0, "N/m", 300, 2500),
            "R": (4.0, "ohm", 2.5, 6.5),
            "C_coil": (9.0, "J/K", 4, 20),
            "G_coil": (0.35, "W/K", 0.12, 1.0),
            # always: a resonance that nothing damps is no rig, and what a refit leaves of a signal in it has no linear measure
            "damping": (7.0, "N*s/m", 1.5, 30),
        }
        if knows["back_emf"]:
            belief["K_e"] = (9.0, "V*s/m", 4, 18)
        if knows["inductance"]:
            belief["L"] = (4e-3, "H", 1e-3, 1.2e-2)
        theta = _draw(belief, rng)
        theta["knows_copper"] = float(knows["copper_resistance"])
        n, period = (4000 if short else 9000), 0.005
        runs = []
        for _ in range(2):
            t = clock(n, period, rng)
            hold = levels(t, rng, schedule, 1.6, 4.0) * (1 if schedule == "warm-up" else 1)
            tones = sum(
                rng.uniform(0.2, 0.5) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
                for f in rng.uniform(0.3, 6.0, 5)
            )
            current = vigour * np.convolve(
                hold * rng.choice([-1, 1]) + 0.5 * tones * (hold > 0),
                np.hanning(41) / np.hanning(41).sum(),
                "same",
            )
            runs.append(
                {
                    "t": t,
                    "drive": np.round(current, 6),
                    "held": False,
                    "substeps": 12,  # 4 would leave 3 sigmas of their own
                    "air": room(t, rng, 0.3),
                    "start": rng.normal(0, 3e-6),
                    "start_coil": rng.normal(0, 0.1),
                }
            )
        grow = " * (1 + 0.00393 * (coil - 20))"
        flows = {
            "motor": {"into": "velocity", "rate": "gain * current", "unit": "N"},
            "spring": {"from": "velocity", "rate": "stiffness * position", "unit": "N"},
        }
        flows |= {
            "damper": {"from": "velocity", "rate": "damping * velocity", "unit": "N"},
            "travel": {"into": "position", "rate": "velocity", "unit": "m/s"},
            "joule": {
                "into": "coil",
                "rate": "R * current**2" + (grow if knows["copper_resistance"] else ""),
                "unit": "W",
            },
            "coil_to_air": {"from": "coil", "rate": "G_coil * (coil - air)", "unit": "W"},
        }
        volts = (
            "R * current"
            + (grow if knows["resistance_temperature"] else "")
            + (" + K_e * velocity" if knows["back_emf"] else "")
        )
        inputs = {"current": {"unit": "A", "between_samples": "linear"}}
        if knows["inductance"]:
            inputs["current_rate"] = {"unit": "A/s"}
            volts += " + L * current_rate"
        inputs["air"] = {"unit": "degC", "column": "air_temperature", "between_samples": "linear"}
        outputs = ["position_read", "voltage", "coil_temperature"]
        plant = {
            "format": "thermoctl-plant/1",
            "title": "Voice-coil stage on flexures",
            "inputs": inputs,
            "parameters": _parameter_block(belief),
            "nodes": {
                "velocity": {"unit": "m/s", "storage": "mass", "initial": 0},
                "position": {"unit": "m", "storage": 1, "initial": 0, "initial_sigma": 1e-5},
                "coil": {"unit": "degC", "storage": "C_coil", "initial": "air", "initial_sigma": 0.2},
            },
            "flows": flows,
            "outputs": {
                "position_read": {"value": "position * 1e3", "unit": "mm", "noise": 0.002},
                "voltage": {"value": volts, "unit": "V", "noise": 0.01},
                "coil_temperature": {"value": "coil", "unit": "degC", "noise": 0.15},
            },
        }
        for run in runs:
            run["current_rate"] = np.round(np.append(np.diff(run["drive"]) / np.diff(run["t"]), 0.0), 5)

        def outputs_of(k: int, rows: list[Variant]) -> np.ndarray:
            run = runs[k]
            with np.errstate(over="ignore", invalid="ignore"):
                states = simulate(theta, run, rows)
            out = np.empty((len(rows), n, 3))
            for r, row in enumerate(rows):
                p = {**theta, **row.theta}
                present = {e: q for e, _, q in row.effects}
                coil, v = states["coil"][r], states["velocity"][r]
                ohm = p["R"] * np.ones(n)
                if knows["resistance_temperature"] or "resistance_temperature" in present:
                    ohm = ohm * (1 + 0.00393 * (coil - 20))
                volt = (
                    ohm * run["drive"]
                    + (p["K_e"] if knows["back_emf"] else present.get("back_emf", {}).get("K", 0.0)) * v
                )
                volt = (
                    volt
                    + (p["L"] if knows["inductance"] else present.get("inductance", {}).get("L", 0.0))
                    * run["current_rate"]
                )
                local = run | {"position": states["position"][r]}
                for j, y in enumerate((1e3 * states["position"][r], volt, coil)):
                    out[r, :, j] = _fault(rows, r, outputs[j], local, y, j == 2)
            return out

        span = runs[0]["t"][-1]
        force, travel, pace = 12.0, 0.01, 0.08
        suspects = friction_suspects(force * 0.4, pace, travel) + drive_suspects(1.6, runs, period, travel)
        suspects.append(Suspect("creep", "velocity", lambda s: {"K": 120.0 * s, "TAU": 3.0}, top=4))
        suspects.append(Suspect("force_constant_temperature", "motor", lambda s: {"B": 0.0012 * s}, top=6))
        for effect, suspect in {
            "back_emf": Suspect("back_emf", "voltage", lambda s: {"K": 9.0 * s}, top=3),
            "inductance": Suspect("inductance", "voltage", lambda s: {"L": 4e-3 * s}, top=4),
            "resistance_temperature": Suspect(
                "resistance_temperature", "voltage", lambda s: {"A": 0.00393}, top=1
            ),
            "copper_resistance": Suspect("copper_resistance", "joule", lambda s: {"A": 0.00393}, top=1),
        }.items():
            if not knows[effect]:
                suspects.append(suspect)
        for output, swing, air in zip(outputs, (8.0, 5.0, 15.0), (False, False, True), strict=True):
            suspects += [
                s
                for s in sensor_suspects(output, period, span, swing, air, rng)
                if s.effect != "sensor_gain" or air
            ]
        suspects.append(
            Suspect("cyclic_error", "position_read", lambda s: {"A": 0.004 * s, "P": 5e-4, "PHI": 0.4})
        )
        unknowns = [
            Suspect("?sticky_zone", "velocity", lambda s: {"F": 0.1 * force * s, "X": 0.002}, top=6),
            Suspect("?one_way_gain", "motor", lambda s: {"A": 0.05 * s}, top=4, aliases=("velocity",)),
        ]
        columns = {"current": "drive", "current_rate": "current_rate", "air_temperature": "air"}
        return Scene.of(plant, theta, runs, columns, outputs_of, suspects, unknowns)
