"""The command `plant linearise`: the compensator's model computed from a plant file."""

from __future__ import annotations

import argparse

from thermoctl.identify import linearise as thermal_model
from thermoctl.identify.modelfile import save_model
from thermoctl.plant import load
from thermoctl.rig.channels import DEFAULT, points_of_file


def linearise(args: argparse.Namespace) -> int:
    """Return the compensator's model file from a thermal plant."""
    plant = load(args.plant)
    channels = points_of_file(args.points) if args.points else DEFAULT
    model = thermal_model.linearise(
        plant, args.period, args.sensor_period, args.kind, density=args.heat_density, channels=channels
    )
    poles = model.meta["time_constants_s"]
    print(
        f"{plant.title}: order {len(model.A_minus_I)}, time constants {poles[0]:.4g} to {poles[-1]:.4g} s, "
        f"coil gain {model.gain[0, 0]:.4g}"
    )
    if args.out:
        print(save_model(args.out, model, args.rig, [args.plant], replace=args.replace))
    return 0
