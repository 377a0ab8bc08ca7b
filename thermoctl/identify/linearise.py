"""Compute the compensator's model from a thermal plant file instead of data.

Rises above the air r = T - air of a plant that is linear in its temperatures:

    dr/dt = A r + b P - 1 d(air)/dt,     readings y = C r
    growth of the output e = a . r + (sum a)(air - air at start)

At the loop's period h, in delta form so that no digits are lost near 1:

    A_h - I = A Phi,  B_h = Phi [b, -1],  Phi = integral of exp(A s) over 0..h

and, for a square C, in the coordinates of the readings: alpha = C A_h C^-1, beta = C B_h (33).

Process noise is white heat of density q (W^2 s) into every body; it represents the plant's errors.
Measurement noise is the thermocouple's noise and its resolution. The steady Kalman gain solves the discrete
Riccati equation at the sensor's period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from thermoctl.control.model import CompensatorModel
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Output, Plant
from thermoctl.rig.channels import DEFAULT, Channels

AIR, VOLTAGE, CURRENT, POWER, ERROR = "air_c", "voltage_v", "current_a", "power_w", "position_error_um"
HEAT_DENSITY = 0.05  # W^2 s: 0.03 W of unknown heat in each body over a minute


@dataclass(frozen=True)
class Thermal:
    """A plant's heat in continuous time.

    A (n, n) 1/s, b (n,) K/J, C (m, n), a (n,) um/K, air_um_k, capacity (n,) J/K, variance (m,) of the
    readings, K^2."""

    A: np.ndarray
    b: np.ndarray
    C: np.ndarray
    a: np.ndarray
    air_um_k: float
    capacity: np.ndarray
    variance: np.ndarray


def _signals(
    plant: Plant, temperatures: tuple[str, ...]
) -> tuple[dict[str, str], dict[str, Output], tuple[str, ...]]:
    """Return inputs and outputs by column, and the columns that give the power. Raises InputError."""
    inputs = {i.column: i.name for i in plant.inputs.values()}
    outputs = {o.column: o for o in plant.outputs.values()}
    powered = (VOLTAGE, CURRENT) if VOLTAGE in inputs else (POWER,)
    for column in (AIR, *powered):
        if column not in inputs:
            raise InputError(
                f"{plant.file}: no input reads the column '{column}'; a compensator is made from a thermal plant "
                "driven by air_c and voltage_v, current_a (or power_w), such as config/plants/actuator_thermal.yaml"
            )
    for column in (*temperatures, ERROR):
        if column not in outputs:
            raise InputError(
                f"{plant.file}: no output for the column '{column}'; a compensator needs {ERROR} and "
                f"the temperatures of all points of the rig: {', '.join(temperatures)}"
            )
    return inputs, outputs, powered


def thermal(plant: Plant, at_c: float = 25.0, channels: Channels = DEFAULT) -> Thermal:
    """Return the plant's matrices at the temperature `at_c`, for a rig with these channels.

    Columns of its inputs and outputs must be the program's signals (air_c, voltage_v and current_a or
    power_w, the points' POINT_c, position_error_um). Raises InputError."""
    inputs, outputs, powered = _signals(plant, channels.temperatures)
    nodes = list(plant.nodes)  # nodes that are states; the others keep their initial value
    point: dict[str, float] = (
        {p.name: p.value for p in plant.parameters.values()}
        | {i: 0.0 for i in plant.inputs}
        | {n: at_c for n in nodes}
        | {inputs[AIR]: at_c, "t": 0.0}
    )
    slopes, capacities = [], []
    for n in plant.nodes.values():
        net = ex.ZERO
        for f in plant.flows.values():
            net = ex.add(
                net, f.rate if f.target == n.name else ex.neg(f.rate) if f.source == n.name else ex.ZERO
            )
        if net is ex.ZERO:  # no flow: the node keeps its start, to which growth is relative
            nodes.remove(n.name)
            continue
        slopes.append(ex.div(net, n.storage))
        capacities.append(n.storage)

    def values(exprs: list[ex.Expr], where: dict[str, float]) -> np.ndarray:
        """Return the values of expressions (n,) at the point `where`."""
        return np.array([float(ex.evaluate(e, where)) for e in exprs])

    rest = values(slopes, point)
    A = np.array([values([ex.derivative(e, n) for n in nodes], point) for e in slopes])
    if np.max(np.abs(rest), initial=0.0) > 1e-9 or np.max(
        np.abs(A.sum(axis=1) + values([ex.derivative(e, inputs[AIR]) for e in slopes], point))
    ) > 1e-9 * np.max(np.abs(A)):
        worst = nodes[int(np.argmax(np.abs(rest)))]
        raise InputError(
            f"{plant.file}: without power the plant does not rest at the air's temperature ('{worst}' drifts "
            f"by {np.max(np.abs(rest)):.3g} K/s); such a plant has no model of rises above the air"
        )
    one_watt = values(slopes, point | {inputs[c]: 1.0 for c in powered})
    C = np.array(
        [values([ex.derivative(outputs[c].value, n) for n in nodes], point) for c in channels.temperatures]
    )
    growth = outputs[ERROR].value
    a = values([ex.derivative(growth, n) for n in nodes], point)
    air = float(a.sum()) + float(ex.evaluate(ex.derivative(growth, inputs[AIR]), point))
    variance = np.array(
        [outputs[c].noise_sd ** 2 + (outputs[c].resolution or 0.0) ** 2 / 12 for c in channels.temperatures]
    )
    capacity = values(capacities, point)
    return Thermal(A, one_watt - rest, C, a, air, capacity, np.where(variance > 0, variance, 1e-4))


def discrete(
    model: Thermal, period_s: float, density: float = HEAT_DENSITY
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A_h - I (n, n), B_h (n, 2) and the process noise's covariance (n, n) K^2 over one period."""
    n = len(model.A)
    phi = expm(np.block([[model.A, np.eye(n)], [np.zeros((n, 2 * n))]]) * period_s)[:n, n:]
    heat = np.diag(density / model.capacity**2)
    loan = expm(np.block([[-model.A, heat], [np.zeros((n, n)), model.A.T]]) * period_s)  # van Loan 1978
    covariance = loan[n:, n:].T @ loan[:n, n:]
    return model.A @ phi, phi @ np.column_stack([model.b, -np.ones(n)]), (covariance + covariance.T) / 2


def linearise(
    plant: Plant,
    period_s: float = 0.001,
    sensor_period_s: float = 0.1,
    kind: str = "kalman",
    density: float = HEAT_DENSITY,
    expansion_period_s: float = 1.0,
    channels: Channels = DEFAULT,
) -> CompensatorModel:
    """Return the compensator's model of a thermal plant, for a rig with these channels.

    `kind` 'kalman' (steady gain) or 'mkf' (scalar recursion with a map zeta = covariance of the steady
    filter's errors with the coil's). Raises InputError."""
    model = thermal(plant, channels=channels)
    step, B, _ = discrete(model, period_s, density)
    slow, _, noise = discrete(model, sensor_period_s, density)
    A, C1, R = np.eye(len(slow)) + slow, model.C[:1], np.diag(model.variance[:1])
    try:
        P = solve_discrete_are(A.T, C1.T, noise, R)
    except (np.linalg.LinAlgError, ValueError) as e:
        raise InputError(f"{plant.file}: no steady Kalman gain exists: {e}") from None
    C, square = model.C, model.C.shape[0] == model.C.shape[1] and np.linalg.cond(model.C) < 1e8
    T = C if square else np.eye(len(A))  # state -> readings, the coordinates of (33), if C is invertible
    back = np.linalg.inv(T)
    P_read = C @ P @ C.T
    gain = (
        T @ np.linalg.solve(C1 @ P @ C1.T + R, C1 @ P).T if kind == "kalman" else T @ P @ C[0] / P_read[0, 0]
    )
    b2, *_ = np.linalg.lstsq(C.T, model.a, rcond=None)
    if np.max(np.abs(C.T @ b2 - model.a)) > 1e-9 * np.max(np.abs(model.a), initial=1e-12):
        raise InputError(f"{plant.file}: {ERROR} depends on a body whose temperature no output reads")
    return CompensatorModel(
        kind,
        period_s,
        T @ step @ back,
        T @ B,
        C @ back,
        gain,
        float((C @ noise @ C.T)[0, 0]),
        float(model.variance[0]),
        0.0,
        np.zeros(len(C)),
        b2,
        expansion_period_s,
        b_air=model.air_um_k,
        points=channels.point_names,
        meta={
            "made_from": "plant linearise",
            "plant": plant.title,
            "sensor_period_s": sensor_period_s,
            "heat_density_w2_s": density,
            "time_constants_s": [round(float(q), 3) for q in np.sort(-1 / np.linalg.eigvals(model.A).real)],
        },
    )
