"""The response to a white force is measured by forces that hold every frequency once, whatever the order of names."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.fft import dct

from tests.diagnose.changes import order
from tests.diagnose.test_roles import blocks
from thermoctl.diagnosis.data.coordinates import Coordinates
from thermoctl.diagnosis.evidence.where import responses, white_forces
from thermoctl.plant import from_plain
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def test_the_forces_hold_every_frequency_once():
    for n in (7, 60, 2400):
        np.testing.assert_allclose((dct(white_forces(n), axis=0, norm="ortho") ** 2).sum(axis=1), 1.0)


def _variances(rig) -> dict[tuple[str, str, str], np.ndarray]:
    """By recording, node and output."""
    plant = from_plain(rig.plant)
    model = compile_plant(plant)
    drives = [model.excitation(Table(k, k, c["t"], c)) for k, c in rig.recordings.items()]
    coordinates = Coordinates(drives)
    values, dx0 = np.array([model.vector(None)] * len(drives)), np.zeros((len(drives), len(model.uncertain)))
    found = responses(SimpleNamespace(model=model, values=values, dx0=dx0), drives, coordinates, set())
    return {
        (drives[c.recording].name, n, model.outputs[c.output]): row
        for c, white in zip(coordinates.channels, found.white, strict=True)
        for n, row in zip(found.nodes, white, strict=True)
    }


def test_the_order_of_nodes_and_recordings_does_not_change_a_response():
    rig = blocks()
    c = rig.recordings["run"] | {
        n: rig.recordings["run"]["air"] for n in ("near_c", "far_c", "volts", "length")
    }
    rig.recordings.update(run=c, other={k: v[:40] for k, v in c.items()})
    one, other = _variances(rig), _variances(order(rig))
    assert one.keys() == other.keys()
    for key, row in one.items():
        np.testing.assert_allclose(other[key], row, rtol=1e-6, atol=1e-12, err_msg=str(key))
