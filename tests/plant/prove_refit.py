"""Parameter recovery: do 95 % intervals of a refit hold the truth in 90 to 98 % of random truths, by kind of rig and noise?

    python tests/plant/prove_refit.py [--truths 100] [--kind WORD]          (make prove-refit)

Each truth: every free parameter drawn inside its range, the recording simulated, noise and the sensor's steps added, and
the plant with its own (wrong) beliefs refitted. Counted are parameters that the report calls 'ok'. White noise: the plant's
own figure is right. Coloured noise: AR(1) of the same standard deviation, correlation PHI between neighbouring samples, of
which the refit is told nothing: it is measured on the residuals, as `thermoctl refit --noise ar1` does.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from thermoctl.plant import load, loads
from thermoctl.plant.fitting.estimate import report
from thermoctl.plant.fitting.noise import coloured
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Scale
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.table import Table

HEAD = "format: thermoctl-plant/1\n"
RIGS = {
    "two heated blocks": HEAD
    + """
inputs: {heat: {unit: W}, air: {unit: degC, between_samples: linear}}
parameters: {C_1: {value: 6, unit: J/K, range: [2, 14]}, C_2: {value: 6, unit: J/K, range: [2, 14]},
             G_1: {value: 0.05, unit: W/K, range: [0.015, 0.15]}, G_12: {value: 0.02, unit: W/K, range: [0.004, 0.08]},
             G_2: {value: 0.05, unit: W/K, range: [0.015, 0.15]}}
nodes: {a: {unit: degC, storage: C_1, initial: air, initial_sigma: 0.3}, b: {unit: degC, storage: C_2, initial: air, initial_sigma: 0.3}}
flows: {power: {into: a, rate: heat, unit: W}, ab: {from: a, into: b, rate: G_12 * (a - b), unit: W},
        a_air: {from: a, rate: G_1 * (a - air), unit: W}, b_air: {from: b, rate: G_2 * (b - air), unit: W}}
outputs: {T_a: {value: a, unit: degC, noise: 0.08, resolution: 0.1}, T_b: {value: b, unit: degC, noise: 0.08, resolution: 0.1}}""",
    "free carriage": HEAD
    + """
inputs: {heat: {unit: V}, air: {unit: degC}}
parameters: {mass: {value: 90, unit: kg, range: [40, 160]}, damping: {value: 200, unit: N*s/m, range: [20, 800]},
             stiffness: {value: 30, unit: N/m, range: [5, 100]}}
nodes: {v: {unit: m/s, storage: mass, initial: 0}, x: {unit: m, storage: 1, initial: 0, initial_sigma: 0.001}}
flows: {motor: {into: v, rate: 8 * (heat - 1) * (air > 0), unit: N}, damper: {from: v, rate: damping * v, unit: N},
        spring: {from: v, rate: stiffness * x, unit: N}, travel: {into: x, rate: v, unit: m/s}}
outputs: {encoder: {value: x * 1e3, unit: mm, noise: 0.5}}""",
    "cascaded tanks": HEAD
    + """
inputs: {heat: {unit: V}, air: {unit: V}}
parameters: {k: {value: 0.05, unit: 1/s, range: [0.03, 0.1]}, k_1: {value: 0.06, unit: V**0.5/s, range: [0.04, 0.15]},
             k_2: {value: 0.06, unit: V**0.5/s, range: [0.04, 0.15]}}
nodes: {upper: {unit: V, storage: 1, initial: 3}, lower: {unit: V, storage: 1, initial: 2, initial_sigma: 0.1}}
flows: {pump: {into: upper, rate: k * (heat + 1) * (air > 0), unit: V/s},
        down: {from: upper, into: lower, rate: "k_1 * sqrt(max(upper, 0.01))", unit: V/s},
        drain: {from: lower, rate: "k_2 * sqrt(max(lower, 0.01))", unit: V/s}}
outputs: {level: {value: lower, unit: V, noise: 0.03}}""",
}


ACTUATOR = Path(__file__).parents[2] / "config/plants/actuator_thermal.yaml"
PHI = 0.8  # of the coloured noise


def recording(rng, n=900, step_s=2.0):
    """Levels held for 45 samples each, slowly swinging air; the actuator reads the same levels as current and voltage."""
    heat = np.repeat(rng.choice([0.0, 1.0, 2.5], n // 45 + 1), 45)[:n]
    t = np.arange(n) * step_s
    air = 22 + 0.3 * np.sin(t / 400)
    return Table(
        "truth",
        "truth",
        t,
        {"heat": heat, "air": air, "air_c": air, "current_a": 0.4 * heat, "voltage_v": 2.0 * heat},
    )


def one(plant, model, rng, colour, **size):
    """(inside, counted) of one random truth, or None where the truth cannot be simulated."""
    free = {p.name: p for p in plant.parameters.values() if p.range}
    truth = {q: Scale(p).value(rng.uniform(0.15, 0.85)) for q, p in free.items()}
    drive = model.excitation(recording(rng, **size))
    dx0 = np.array([plant.nodes[n].initial_sigma for n in model.uncertain]) * rng.normal(
        size=len(model.uncertain)
    )
    try:
        clean = model.run(drive, truth, dx0).y
    except SimulationError:
        return None
    phi = PHI if colour else 0.0
    for j, o in enumerate(plant.outputs.values()):
        white = rng.normal(size=len(clean))
        white[0] /= np.sqrt(1 - phi**2)
        y = clean[:, j] + o.noise_sd * np.sqrt(1 - phi**2) * lfilter([1.0], [1.0, -phi], white)
        drive.y[:, j] = np.round(y / o.resolution) * o.resolution if o.resolution else y
    drive.scale = None
    found = fit(model, [drive])
    if colour:
        found = fit(model, [drive], coloured(found, [drive]), start=found.z)
    counted = [e for e in report(found) if e.state == "ok"]
    return sum(abs(e.value - truth[e.name]) <= 1.96 * e.sd for e in counted), len(counted)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truths", type=int, default=100)
    parser.add_argument("--kind", default="", help="only rigs whose name holds this word")
    args = parser.parse_args()
    kinds = {kind: (loads(text, kind), {}) for kind, text in RIGS.items()}
    kinds["12-node actuator"] = (load(ACTUATOR), {"step_s": 8.0})
    good = True
    for kind, (plant, size) in kinds.items():
        if args.kind not in kind:
            continue
        model = compile_plant(plant)
        for colour in (False, True):
            begin = time.process_time()
            results = [
                r
                for k in range(args.truths)
                if (r := one(plant, model, np.random.default_rng([7, k]), colour, **size))
            ]
            inside, counted = (sum(r[i] for r in results) for i in (0, 1))
            total = len(results) * len(model.active)
            share = inside / max(counted, 1)
            met = 0.90 <= share <= 0.98
            good &= met
            print(
                f"{kind}, {f'AR(1) {PHI}' if colour else 'white'} noise: {len(results)} truths, {counted} of {total} parameters 'ok', "
                f"95 % intervals hold {100 * share:.1f} % ({'met' if met else 'NOT met'}; "
                f"{time.process_time() - begin:.0f} s of processor time)",
                flush=True,
            )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
