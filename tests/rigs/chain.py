"""A rig whose points are a chain of bodies: its plant files, its points and its rig file, for any names.

A current amplifier drives a stage on a spring; the current heats the first point, heat flows along the chain
and from every body to the air, and each body but the first lengthens the output (a single one does).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

R_OHM, GAIN_UM_A, TAU_S, EXPANSION_UM_K = 5.0, 300.0, 0.01, 0.5


def _heat(names: Sequence[str]) -> dict[str, list[str]]:
    """Return parameters, nodes, flows and outputs of the bodies."""
    capacity = {n: 40.0 + 10.0 * k for k, n in enumerate(names)}
    flows = [
        f"  {a}_to_{b}: {{from: {a}, into: {b}, rate: G * ({a} - {b}), unit: W}}"
        for a, b in zip(names[:-1], names[1:], strict=True)
    ]
    return {
        "parameters": [
            *(["  G: {value: 1.0, unit: W/K}"] if flows else []),
            "  H: {value: 0.2, unit: W/K}",
            f"  a: {{value: {EXPANSION_UM_K}, unit: um/K}}",
            "  T_ref: {value: 22.0, unit: degC}",
            *(f"  C_{n}: {{value: {c}, unit: J/K}}" for n, c in capacity.items()),
        ],
        "nodes": [f"  {n}: {{unit: degC, storage: C_{n}, initial: air}}" for n in names],
        "flows": [*flows, *(f"  {n}_to_air: {{from: {n}, rate: H * ({n} - air), unit: W}}" for n in names)],
        "outputs": [f"  {n}_c: {{value: {n}, unit: degC, noise: 0.05, resolution: 0.1}}" for n in names],
    }


def growth(names: Sequence[str]) -> str:
    """Return the expansion of the output, um, as an expression."""
    return " + ".join(f"a * ({n} - T_ref)" for n in names[1:] or names)


def plants(folder: Path, names: Sequence[str], mode: str = "torque") -> tuple[Path, Path]:
    """Write the whole plant and its thermal part; return both paths.

    With `mode` position the drive is a target, um, and the current is what the spring needs."""
    position = mode == "position"
    current = "(position / gain)" if position else "drive"
    heat = _heat(names)
    whole = [
        "format: thermoctl-plant/1",
        "title: a chain of bodies",
        "inputs:",
        f"  drive: {{unit: {'um' if position else 'A'}}}",
        "  air: {unit: degC, column: air_c, between_samples: linear}",
        "parameters:",
        f"  R: {{value: {R_OHM}, unit: ohm}}",
        "  alpha: {value: 0.00393, unit: 1/K}",
        "  T_20: {value: 20.0, unit: degC}",
        f"  gain: {{value: {GAIN_UM_A}, unit: um/A}}",
        f"  tau: {{value: {TAU_S}, unit: s}}",
        *heat["parameters"],
        "nodes:",
        "  position: {unit: um, storage: 1, initial: 0}",
        *heat["nodes"],
        "flows:",
        f"  spring: {{into: position, rate: ({'drive' if position else 'gain * drive'} - position) / tau, unit: um/s}}",
        f"  joule: {{into: {names[0]}, rate: R * (1 + alpha * ({names[0]} - T_20)) * {current}**2, unit: W}}",
        *heat["flows"],
        "outputs:",
        "  position_um: {value: position, unit: um, column: position_raw_um, noise: 0.01, resolution: 0.005}",
        f"  output_reference_um: {{value: position + {growth(names)}, unit: um, noise: 0.01, resolution: 0.005}}",
        f"  voltage_v: {{value: R * (1 + alpha * ({names[0]} - T_20)) * {current}, unit: V, noise: 0.002}}",
        f"  current_a: {{value: {current}, unit: A, noise: 0.0005}}",
        *heat["outputs"],
    ]
    thermal = [
        "format: thermoctl-plant/1",
        "title: a chain of bodies, thermal",
        "inputs:",
        "  voltage: {unit: V, column: voltage_v}",
        "  current: {unit: A, column: current_a}",
        "  air: {unit: degC, column: air_c, between_samples: linear}",
        "parameters:",
        *heat["parameters"],
        "nodes:",
        *heat["nodes"],
        "flows:",
        f"  joule: {{into: {names[0]}, rate: voltage * current, unit: W}}",
        *heat["flows"],
        "outputs:",
        *heat["outputs"],
        f"  position_error_um: {{value: {growth(names)}, unit: um, noise: 0.015}}",
    ]
    paths = folder / "plant.yaml", folder / "thermal.yaml"
    for path, lines in zip(paths, (whole, thermal), strict=True):
        path.write_text("\n".join(lines) + "\n")
    return paths


def rig_text(
    names: Sequence[str],
    model: str = "",
    labels: dict[str, str] | None = None,
    mode: str = "torque",
    period: str = "1 ms",
) -> str:
    """Return the rig file of a simulated chain with these points, the first of them the coil."""
    points = "\n".join(
        f"  {n}: {{{', '.join([*(['role: coil'] if not k else []), *([f'label: {labels[n]}'] if labels and n in labels else [])])}}}"
        for k, n in enumerate(names)
    )
    return f"""rig: {{name: chain}}
points:
{points}
loop: {{period_s: {period}, priority: 0}}
control: {{mode: {mode}, kp: 0.001, ti_s: 0.01, output_limit: {300 if mode == "position" else 1.5}, setpoint_rate_um_s: 100}}
compensation: {{model: "{model}", enable: true, bound_um: 100, slew_um_s: 5}}
protection:
  required: [position_um, voltage_v, current_a, air_c, {names[0]}_c]
  low: {{position_um: -400, temperatures_c: 0}}
  high: {{position_um: 400, temperatures_c: 120}}
  stale_s: {{position_um: 0.1, temperatures_c: 2}}
  following_um: 50
  coil_limit_c: 110
recording: {{directory: recordings}}
hal:
  backend: simulated
  plant: plant.yaml
  drive_input: drive
  inputs: {{air: {{mean: 22.0, swing: 0.2, period_s: 7200, noise: 0.02, resolution: 0.01}}}}
socket: {{path: rig.sock}}
"""
