"""An effect hidden in each of the ten exported plants; diagnosed with the plant file, and with its FMU as the plant.

`python -m tests.plant.fmu_back [NAME ...]` (make fmu-back) prints a table. A plant with delays is an FMU of co-simulation only,
which is refused.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import time
from pathlib import Path

from tests.export.plants import plants, recording
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.limits import limits
from thermoctl.export.commands import write
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant, load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

NOISE = {"degC": 0.05, "m": 1e-6}
HIDDEN = {  # effect, place as YAML, values; an effect of a drive is named by its input where the plant is an FMU
    "hot-end": ("radiation", "block", {"E": 3e-10}),
    "actuator": ("external_heat_source", "coil", {"Q": 2.0, "T0": 120.0, "T1": 260.0}),
    "room": ("external_heat_source", "room", {"Q": 400.0, "T0": 6000.0, "T1": 15000.0}),
    "tank": ("actuator_saturation", "inflow", {"U": 6e-5}),
    "spring_stage": ("coulomb_friction", "velocity", {"F": 1.0, "W": 1e-4}),
    "extended": ("external_heat_source", "two", {"Q": 0.3, "T0": 130.0, "T1": 270.0}),
    "tabled": ("external_heat_source", "block", {"Q": 0.5, "T0": 50.0, "T1": 140.0}),
    "delayed": ("external_heat_source", "block", {"Q": 0.5, "T0": 50.0, "T1": 140.0}),
    "friction": ("constant_load", "velocity", {"F": 1.0}),
    "static": ("cyclic_error", "y", {"A": 1e-5, "P": 2e-4, "PHI": 0.5}),
}


def case(name: str) -> tuple[Plant, list[Table]]:
    """Return the plant that lacks the effect, and two recordings of the rig that has it."""
    plant, dt = plants()[name]
    outputs = {
        k: o if o.noise else dataclasses.replace(o, noise=NOISE[o.unit]) for k, o in plant.outputs.items()
    }
    plant = dataclasses.replace(plant, outputs=outputs)
    effect, place, values = HIDDEN[name]
    tables = [dataclasses.replace(recording(plant, seed, dt=dt), name=f"run_{seed}") for seed in (1, 2)]
    model = compile_plant(plant)
    rig = Rig(plant, [model.excitation(t) for t in tables], [t.columns for t in tables])
    found = next(c for c in candidates(rig, catalogue()) if c.key == (effect, place))
    truth = compile_plant(found.extend(values), ())
    return plant, [truth.measure(t, seed) for seed, t in enumerate(tables)]


def as_fmu(plant: Plant, table: Table, folder: Path) -> Plant:
    """Return the plant again, by way of an FMU and of a map that says what the description of an FMU does not."""
    path = folder / "plant.fmu"
    write(plant, "fmu", path, table)
    p = plant.plain()
    kept = {
        "inputs": ("column", "role"),
        "nodes": ("initial", "initial_sigma", "storage", "role"),
        "outputs": ("column", "noise", "role"),
    }
    mapped = {
        s: {n: {k: q[k] for k in keys if k in q} for n, q in p.get(s, {}).items()} for s, keys in kept.items()
    }
    mapped["states"] = mapped.pop("nodes")
    mapped["outputs"] = {  # as the exporter calls a reading that is named like a state
        f"{o}_reading" if o in plant.nodes else o: {"column": plant.outputs[o].column, **q}
        for o, q in mapped["outputs"].items()
    }
    (folder / "map.yaml").write_text(yamlfile.dumps(mapped))
    return load(path, folder / "map.yaml")


def named(plant: Plant, tables: list[Table]) -> list[tuple[str, str]]:
    """Return the verdict and the findings of a diagnosis."""
    found = contract(diagnose(plant, tables, catalogue((CATALOGUE,)), limits()))
    return [("verdict", found["verdict"]), *((f["effect"], f["where"]) for f in found["findings"])]


def main(names: list[str]) -> int:
    """Print the table; return 1 where fewer than 8 of 10 are named as from YAML."""
    same = 0
    print("| plant | hidden | from YAML | s | from the FMU | s |\n|---|---|---|---|---|---|")
    for name in names or HIDDEN:
        plant, tables = case(name)
        row = [name, " at ".join(HIDDEN[name][:2])]
        results = []
        with tempfile.TemporaryDirectory() as folder:
            for make in (lambda p=plant: p, lambda p=plant, t=tables[0], f=folder: as_fmu(p, t, Path(f))):
                begin = time.process_time()
                try:
                    results.append(named(make(), tables))
                    row.append("; ".join(" at ".join(q) for q in results[-1]).replace("verdict at ", ""))
                except InputError as e:
                    results.append([])
                    row.append(str(e).split(": ")[1].split(";")[0])
                row.append(f"{time.process_time() - begin:.0f}")
        ours, theirs = ([e for e, _ in r[1:]] for r in results)
        same += bool(theirs) and ours == theirs
        print("| " + " | ".join(row) + " |", flush=True)
    print(f"named as from YAML: {same} of {len(names or HIDDEN)}")
    return int(same < 0.8 * len(names or HIDDEN))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
