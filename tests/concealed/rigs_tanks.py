"""Cascaded tanks, integrated by scipy's LSODA between the samples, event by event: pump in, two or three levels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import odeint

from tests.concealed.compiled import loops
from tests.concealed.rig import Scene, Suspect, clock, levels
from tests.concealed.rigs_thermal import _draw, _fault, _parameter_block, sensor_suspects
from tests.concealed.thermal import Variant


class Tanks:
    """Two or three tanks in cascade, pumped into the upper one, the lower ones with level sensors."""

    name = "tanks"

    def scene(self, rng: np.random.Generator, schedule: str, short: bool, vigour: float = 1.0) -> Scene:
        names = ["upper", "lower"] if rng.random() < 0.6 else ["upper", "middle", "lower"]
        belief: dict[str, tuple] = {"k_pump": (0.05, "1/s", 0.01, 0.2)}
        belief |= {f"k_{n}": (0.06, "V**0.5/s", 0.015, 0.25) for n in names}
        theta = _draw(belief, rng)
        seen = names[1:] if rng.random() < 0.6 else names
        if seen != names:  # without the upper level only k_pump fixes its scale
            belief["k_pump"] = (theta["k_pump"], "1/s")
        n, period = (800 if short else 1600), 3.0
        top = 5.5 * theta["k_upper"] / theta["k_pump"] * 0.5
        runs = []
        for _ in range(2):
            t = clock(n, period, rng)
            pump = levels(t, rng, schedule, top, 160.0, 0.05) * (1 if schedule == "warm-up" else 0.9)
            pump = np.round(pump + 0.25 * top, 4)
            start = {k: float(np.round(rng.uniform(1.5, 4.0), 3)) for k in names}
            runs.append(
                {"t": t, "pump": pump, "air": np.full(n, 22.0)}
                | {f"{k}_start": np.full(n, start[k]) for k in names}
            )
        flows: dict = {"pumped": {"into": "upper", "rate": "k_pump * pump", "unit": "V/s"}}
        for k, name in enumerate(names):
            ends = {"from": name, "into": names[k + 1]} if k + 1 < len(names) else {"from": name}
            flows[f"{name}_outflow"] = {**ends, "rate": f"k_{name} * sqrt(max({name}, 0))", "unit": "V/s"}
        plant = {
            "format": "thermoctl-plant/1",
            "title": f"{len(names)} tanks in cascade",
            "inputs": {"pump": {"unit": "V"}} | {f"{k}_start": {"unit": "V"} for k in names},
            "parameters": _parameter_block(belief),
            "nodes": {
                k: {"unit": "V", "storage": 1, "initial": f"{k}_start", "initial_sigma": 0.03} for k in names
            },
            "flows": flows,
            "outputs": {
                f"level_{k}": {"value": k, "unit": "V", "noise": 0.02, "resolution": 0.005} for k in seen
            },
        }

        def outputs_of(k: int, rows: list[Variant]) -> np.ndarray:
            out = np.empty((len(rows), n, len(seen)))
            for r, row in enumerate(rows):
                states = _integrate(names, {**theta, **row.theta}, row, runs[k])
                for j, name in enumerate(seen):
                    out[r, :, j] = _fault(
                        rows, r, f"level_{name}", runs[k], states[:, names.index(name)], False
                    )
            return out

        peak = {
            x: float(max(_integrate(names, theta, Variant(), r)[:, names.index(x)].max() for r in runs))
            for x in names
        }
        span = runs[0]["t"][-1]
        suspects = [
            Suspect(
                "overflow", x, lambda s, x=x: {"HMAX": peak[x] * max(1.0 - 0.12 * s, 0.4), "A": 0.7}, top=5
            )
            for x in names
        ]
        suspects += [
            Suspect("orifice_exponent", f"{x}_outflow", lambda s: {"N": 0.5 + 0.04 * s}, top=6) for x in names
        ]
        for x in seen:
            suspects += sensor_suspects(f"level_{x}", period, span, 4.0, False, rng, top_value=peak[x])
        suspects.append(
            Suspect("actuator_saturation", "pumped", lambda s: {"U": top * max(1.3 - 0.15 * s, 0.5)}, top=4)
        )
        suspects.append(
            Suspect("actuator_dead_zone", "pumped", lambda s: {"U": 0.25 * top * (1 + 0.05 * s)}, top=4)
        )
        suspects.append(Suspect("actuator_delay", "pumped", lambda s: {"TD": 4 * period * s}, top=6))
        unknowns = [
            Suspect("?siphon", x, lambda s: {"A": 0.25 * s}, top=4, aliases=(f"{x}_outflow",)) for x in names
        ]
        unknowns += [
            Suspect("?clogging", f"{x}_outflow", lambda s: {"A": 0.12 * s}, top=4, aliases=(x,))
            for x in names
        ]
        columns = {"pump": "pump"} | {f"{x}_start": f"{x}_start" for x in names}
        scene = Scene.of(plant, theta, runs, columns, outputs_of, suspects, unknowns)
        for run in runs:
            run["off"] = rng.normal(0, 0.015, len(names))
        return scene


def _integrate(names: list[str], theta: dict, row: Variant, run: dict) -> np.ndarray:
    """Levels (N, tanks), V. Constant-input stretches are integrated whole; overflow is a rate that empties within 0.2 s
    what stands above the rim."""
    t, pump = run["t"], run["pump"]
    k = np.array([theta[f"k_{x}"] for x in names])
    power, rim, share = np.full(len(names), 0.5), np.full(len(names), 1e9), 0.0
    siphon, clog = np.zeros(len(names)), np.zeros(len(names))
    limit, dead, late = 1e9, -1.0, 0.0
    for effect, where, p in row.effects:
        at = names.index(where.removesuffix("_outflow")) if where.removesuffix("_outflow") in names else -1
        if effect == "overflow":
            rim[at], share = p["HMAX"], p["A"]
        elif effect == "orifice_exponent":
            power[at] = p["N"]
        elif effect == "?siphon":
            siphon[at] = p["A"]
        elif effect == "?clogging":
            clog[at] = p["A"]
        elif effect == "actuator_saturation":
            limit = p["U"]
        elif effect == "actuator_dead_zone":
            dead = p["U"]
        elif effect == "actuator_delay":
            late = p["TD"]
    sent = np.where(np.abs(pump) < dead, 0.0, np.minimum(pump, limit))
    level = np.array([run[f"{x}_start"][0] + row.start.get(x, 0.0) for x in names]) + run.get("off", 0.0)
    x_now = np.maximum(level, 1e-3)
    out = np.empty((len(t), len(names)))
    out[0] = x_now
    rate = rate_of(float(theta["k_pump"]), k, power, rim, share, siphon, clog)
    change = np.flatnonzero(np.diff(sent)) + 1  # the input is constant from change to change
    edges = np.concatenate([[0.0], t[change] + late, [t[-1] + late + 1]])
    values = np.concatenate([[sent[0]], sent[change]])
    for i, u in enumerate(values):
        begin, end = edges[i], min(edges[i + 1], t[-1])
        if end <= begin:
            continue
        inside = np.flatnonzero((t > begin) & (t <= end))
        grid = (
            np.concatenate([[begin], t[inside], [end]])
            if not len(inside) or t[inside[-1]] < end
            else np.concatenate([[begin], t[inside]])
        )
        grid, first = np.unique(grid, return_index=True)
        y = odeint(rate, x_now, grid, args=(u,), rtol=1e-8, atol=1e-8, hmax=20.0, mxstep=5000)
        out[inside] = y[np.searchsorted(grid, t[inside])]
        x_now = y[-1]
    return out


def rate_in_python(
    k_pump: float,
    k: np.ndarray,
    power: np.ndarray,
    rim: np.ndarray,
    share: float,
    siphon: np.ndarray,
    clog: np.ndarray,
) -> Callable[[np.ndarray, float, float], np.ndarray]:
    """The same as loops.tank_rate: what it is compared with, and what tells how it goes."""
    special = bool(siphon.any() or clog.any())

    def rate(x: np.ndarray, now: float, u: float) -> np.ndarray:
        """Rates (n,) V/s of the levels (n,) V at the time s and with the pump's V."""
        x = np.maximum(x, 0.0)
        flow = k * x**power
        if special:  # a siphon that starts above 4 V; a filter that clogs in cycles
            flow = (
                flow * (1 + siphon / (1 + np.exp(-(x - 4.0) / 0.05))) * (1 - clog * ((now % 700.0) / 700.0))
            )
        spill = np.maximum(x - rim, 0.0) * 5.0
        d = -flow - spill
        d[0] += k_pump * u
        d[1:] += flow[:-1] + share * spill[:-1]
        return d

    return rate


rate_of = loops.tank_rate
