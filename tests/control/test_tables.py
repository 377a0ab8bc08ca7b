"""One table each of channels, limits and faults: a row that is added reaches everything that derives from it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

import thermoctl
from tests import typed
from thermoctl.control import faults, recorded_faults
from thermoctl.control.model import CompensatorModel, zero_model
from thermoctl.daemon.keep import _fingerprint
from thermoctl.rig.channels import AT, COIL, DEFAULT, FIXED, GROUPS, MAX_POINTS, Point, of_points
from thermoctl.rig.signals import INDEX, NAMES, PAPER, fault_word, fault_words, of_channels

PRODUCT = Path(thermoctl.__file__).parent
_VERSION_2 = """
position_error position_stale position_range position_rate position_frozen
monitored_error monitored_stale monitored_range monitored_rate monitored_frozen
voltage_error voltage_stale voltage_range voltage_rate voltage_frozen
current_error current_stale current_range current_rate current_frozen
air_error air_stale air_range air_rate air_frozen
coil_error coil_stale coil_range coil_rate coil_frozen
amplifier_error amplifier_stale amplifier_range amplifier_rate amplifier_stopped
following_error coil_overtemperature coil_overtemperature_model coil_heating_rate coil_disagrees
power_limit coil_stuck_on compensation_bound compensation_slewing drive_saturated
amplifier_fault amplifier_not_following loop_late amplifier_write not_finite
electrical_disagrees position_disagrees monitored_disagrees
"""
NAMES_2 = tuple(_VERSION_2.split())  # the faults by bit in recordings of law version 2. Data: never changed


def run_with(changes: dict[str, tuple[str, str]], script: str) -> dict[str, object]:
    """Run a script in which modules have a changed source: {module: (text, its replacement)}; return its JSON.

    The law runs interpreted, because a compiled one would still be of the table that it was built from.
    """
    head = f"""
import importlib.util, json, sys
CHANGES = {changes!r}
class Changed:
    def find_spec(self, name, path=None, target=None):
        if name not in CHANGES and name != "thermoctl.control.law":
            return None
        file = {str(PRODUCT.parent)!r} + "/" + name.replace(".", "/") + ".py"
        return importlib.util.spec_from_file_location(name, file, loader=Loader(name, file))
class Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, name):
        text = open(self.path).read()
        old, new = CHANGES.get(name, ("", ""))
        assert old in text, (name, old)
        return compile(text.replace(old, new, 1) if old else text, self.path, "exec")
sys.meta_path.insert(0, Changed())
"""
    done = subprocess.run(
        [sys.executable, "-c", head + script], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def test_tables_are_consistent():
    """Recorded words hold every channel and fault exactly."""
    most = of_points([Point("motor", role="coil"), *(Point(f"p{k}") for k in range(1, MAX_POINTS))])
    for channels in (DEFAULT, most):
        row, table = of_channels(channels), channels.table
        assert not row.duplicates() and channels.coil == channels.names[COIL]
        assert [c.thermal for c in table] == [c >= AT["air_c"] for c in range(len(table))]
        assert tuple(c.point for c in table[COIL:]) == channels.point_names
        assert [row.names[k] for k in range(row.readings.start, row.readings.stop)] == list(
            channels.signal.values()
        )
    assert [len(range(*s.indices(len(PAPER)))) for s in (PAPER.fresh, PAPER.status, PAPER.delay)] == [1, 1, 1]
    assert [s.stop - s.start for s in (row.fresh, row.status, row.delay)] == [2, 3, 5]
    assert len(set(faults.BIT.values())) == len(faults.FAULTS) == len(faults.BIT)
    assert set(faults.BIT.values()) <= set(range(64))
    assert set(faults.READING_BITS) == set(GROUPS) == {c.group for c in DEFAULT.table}
    assert faults.BIT["amplifier_write"] < 53, "external_bits is one float64"


def test_the_faults_of_old_recordings_keep_their_bits():
    """No bit that a recording of version 2 holds has got another meaning."""
    assert {bit: faults.NAMES[bit] for bit in range(53)} == dict(enumerate(NAMES_2))


def test_types_of_the_law_are_up_to_date(capsys):
    """`python -m tests.typed --check`: law.pxd agrees with law.py and Parameters."""
    assert typed.main(["--check"]) == 0, capsys.readouterr().out


def test_a_channel_is_added_in_one_row():
    """A new channel reaches the back ends, settings, parameters, record, law, status and its faults."""
    end = '    Channel("amplifier_fault", "1", "amplifier", "the amplifier\'s own error code; 0 none", 0.0, code=True),\n'
    row = '    Channel("humidity", "1", "monitored", "humidity of the chamber", 0.0, 1.0),\n'
    found = run_with(
        {"thermoctl.rig.channels": (end, end + row)},
        """
import numpy as np
from thermoctl_hal.base.backend import ROLES, Sample
from tests import reference
from thermoctl.rig import channels, signals
from thermoctl.control import causes, faults, law, model
from thermoctl.daemon.answers import readings
from thermoctl.control.model import Parameters, zero_model
p = Parameters(0.0, 1.0, 0.0, 1.0)
new = channels.AT["humidity"]
p.high[new], p.required[new] = 0.9, 1.0
tick = law.Law(zero_model(), p, 0.001)
value, status = np.zeros(len(ROLES)), np.zeros(len(ROLES), np.uint8)
value[new] = 0.95
tick.bind(value, np.ones(len(ROLES), np.uint8), status)
tick.step(0.001)
print(json.dumps({
    "role": ROLES[new], "sample": len(Sample().value),
    "limit": "high[humidity]" in model.packed_names(ROLES), "signal": "humidity" in signals.NAMES,
    "page": "humidity of the chamber" in reference.signals(), "status": readings.sources(channels.DEFAULT)["humidity"][0],
    "cause": "humidity" in causes.channels_of("monitored_range", channels.DEFAULT), "trips": tick.trips == 1 << faults.BIT["monitored_range"],
    "replayed": bool(tick.faults >> faults.BIT["monitored_range"] & 1),
}))""",
    )
    count = len(FIXED) + len(DEFAULT.points) + 1
    assert found == {
        "role": "humidity",
        "sample": count,
        "limit": True,
        "signal": True,
        "page": True,
        "status": "humidity",
        "cause": True,
        "trips": True,
        "replayed": True,
    }


def test_a_limit_is_added_in_one_row(tmp_path):
    """A new limit reaches the configuration, its page, the law's parameters and the law's types."""
    anchor = "    coil_rate_k_s: float = option("
    row = '    voltage_limit_v: float = option("largest mean coil voltage", 48.0, "V", 0.0, 1e3)\n'
    config = tmp_path / "rig.yaml"
    config.write_text(
        "control: {kp: 0.1, ti_s: 1, output_limit: 1}\nprotection: {voltage_limit_v: 12 V}\n"
        "hal: {backend: simulated, plant: plant.yaml}\n"
    )
    found = run_with(
        {"thermoctl.control.limits": (anchor, row + anchor)},
        f"""
from tests import reference
from thermoctl.configuration import settings
from tests import typed
from thermoctl.control import law, model
from thermoctl.daemon.tick.assemble import law_parameters
p = law_parameters(settings.load_settings({str(config)!r}))
tick = law.Law(model.zero_model(), model.Parameters.unpack(p.pack()), 0.001)
text = (typed.CONTROL / "law.pxd").read_text()
print(json.dumps({{
    "law": tick.p.voltage_limit_v, "page": "largest mean coil voltage" in reference.configuration(),
    "declared": "voltage_limit_v" in typed.declarations(text, law), "stale": "voltage_limit_v" not in text,
}}))""",
    )
    assert found == {"law": 12.0, "page": True, "declared": True, "stale": True}


def test_a_fault_is_added_in_one_row():
    """A new fault takes bit 54, is recorded in the second word, and is shown, explained and decoded."""
    found = run_with(
        {
            "thermoctl.control.faults": (
                "_ROWS = (",
                '_ROWS = (Fault(54, "door_open", "critical", "its door is open", "Somebody.", "look", "close it"),',
            )
        },
        f"NAMES_2 = {NAMES_2!r}"
        """
import numpy as np
from tests import reference
from thermoctl.rig import signals
from thermoctl.control import arming, faults, law
from thermoctl.control.model import Parameters, zero_model
tick = law.Law(zero_model(), Parameters(0.0, 1.0, 0.0, 1.0), 0.001)
for k in range(law.WARM_UP_TICKS + 3):
    tick.step(0.001, external=1 << faults.BIT["door_open"])
row = np.zeros(len(signals.NAMES))
row[signals.AT["state"]:][:len(law.OUTPUTS)] = tick.outputs[:len(law.OUTPUTS)]
print(json.dumps({
    "state": arming.STATES[tick.state], "shown": "door_open" in [f.name for f in faults.decode(signals.fault_word(row))],
    "second word": row[signals.INDEX["fault_bits_2"]], "page": "`fault_bits_2` (value 2)" in reference.fault(faults.BY_NAME["door_open"]),
    "recorded": faults.NAMES[54], "others": all(faults.NAMES[b] == n for b, n in enumerate(NAMES_2)),
}))""",
    )
    assert found == {
        "state": "FAULT",
        "shown": True,
        "second word": 2.0,
        "page": True,
        "recorded": "door_open",
        "others": True,
    }


def test_a_model_field_is_added_in_one_row():
    """A new field of the model reaches model files, the recording's metadata and the warm start's fingerprint."""
    anchor = "    meta: dict[str, Any]"
    found = run_with(
        {"thermoctl.control.model": (anchor, '    tilt: float = _number("um/K", 0.5)\n' + anchor)},
        """
import dataclasses
from thermoctl.control.model import Parameters, zero_model
from thermoctl.daemon.keep import _fingerprint
from thermoctl.daemon.recorder import law_metadata, read_law_metadata
from thermoctl.identify import modelfile
model = dataclasses.replace(zero_model(), tilt=0.25)
text = law_metadata(model, Parameters(0.0, 1.0, 0.0, 1.0), 0.001, 0, 0, None)
old = json.loads(text)
del old["model"]["tilt"]
print(json.dumps({
    "recording": read_law_metadata(text)["model"].tilt, "before it": read_law_metadata(json.dumps(old))["model"].tilt,
    "unit": modelfile.UNITS["tilt"], "fingerprint": _fingerprint(model) != _fingerprint(zero_model()),
}))""",
    )
    assert found == {"recording": 0.25, "before it": 0.5, "unit": "um/K", "fingerprint": True}


def test_a_recording_decodes_to_its_own_faults():
    """With a table in the metadata the names are its own; without one those of this program."""
    assert recorded_faults.names(1 << 34 | 1, recorded_faults.table({})) == (
        "position_error",
        faults.NAMES[34],
    )
    stored = {"faults": json.dumps({34: "lamp_broken", 60: "of_a_newer_program"})}
    assert recorded_faults.names(1 << 34 | 1 << 60, recorded_faults.table(stored)) == (
        "lamp_broken",
        "of_a_newer_program",
    )
    assert recorded_faults.names(1 << 59, recorded_faults.table(stored)) == ("bit 59",)


def test_two_words_hold_every_bit():
    """All 64 bits pass through two float64 columns."""
    rows = np.zeros((2, len(NAMES)))
    rows[:, INDEX["fault_bits"]], rows[1, INDEX["fault_bits_2"]] = 2.0**53 - 1, 2.0**11 - 1
    assert fault_word(rows[1]) == 2**64 - 1 == int(fault_words(rows)[1])
    assert fault_word(rows[0]) == 2**53 - 1 == int(fault_words(rows)[0])
    rows[0, INDEX["fault_bits"]] = np.nan
    assert int(fault_words(rows)[0]) == 0


def test_the_fingerprint_covers_every_number():
    """A change of any number of the model gives another fingerprint."""
    model = zero_model()
    assert isinstance(model, CompensatorModel)
    changed = [
        _fingerprint(type(model)(**{**vars(model), name: vars(model)[name] + 0.25}))
        for name in ("b_air", "offset_um", "R_w", "R_v", "expansion_period_s", "f1")
    ]
    assert len({_fingerprint(model), *changed}) == 1 + len(changed)
