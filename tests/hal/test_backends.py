"""The simulated and the spoiled rig."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.hal.conftest import CONFIG, make_settings
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl_hal.base.backend import (
    ABSENT,
    AMP_DISABLED,
    AMP_ENABLED,
    ERROR,
    OK,
    ROLE,
    ROLES,
    STALE,
    Sample,
)
from thermoctl_hal.rig.make import make_backend
from thermoctl_hal.simulated.faulty import FaultInjector, schedule

POSITION, COIL, AIR, STATE = (ROLE[r] for r in ("position_um", "coil_c", "air_c", "amplifier_state"))


def play(backend, ticks, drive=lambda k: 0.2, period_s=0.001, start_s=0.0):
    """Run a back end in simulated time; all values, fresh flags and states as arrays (ticks, roles)."""
    values, fresh, status = [], [], []
    for k in range(ticks):
        s = backend.read(start_s + k * period_s)
        values.append(s.value.copy())
        fresh.append(s.fresh.copy())
        status.append(s.status.copy())
        backend.write(drive(k), True)
    return np.array(values), np.array(fresh), np.array(status)


def simulated(tmp_path, **hal):
    backend = make_backend(make_settings(tmp_path, **hal))
    backend.open()
    return backend


def test_simulated_rig_is_deterministic_and_its_seed_counts(tmp_path):
    runs = [play(simulated(tmp_path, seed=seed), 500)[0] for seed in (7, 7, 8)]
    assert np.array_equal(runs[0], runs[1], equal_nan=True)
    assert not np.array_equal(runs[0], runs[2], equal_nan=True)


def test_simulated_rig_follows_the_plant(tmp_path):
    """Against an independent simulation of the same plant by scipy's view of the recording: Model.simulate."""
    values, _, _ = play(simulated(tmp_path), 1001)
    model = compile_plant(load(CONFIG / "plants/actuator.yaml"))
    t = np.arange(1001) * 0.001
    table = Table("run", "run", t, {"drive": np.full(1001, 0.2), "air_c": np.full(1001, 22.0)})
    y = model.simulate(table).y
    assert np.abs(values[1:, POSITION] - y[1:, model.outputs.index("position_um")]).max() < 0.3
    assert abs(values[-1, POSITION] - y[-1, model.outputs.index("position_um")]) < 0.06


def test_sensors_have_their_steps_noise_and_rates(tmp_path):
    values, fresh, status = play(simulated(tmp_path), 5000)
    steps = values[:, POSITION] / 0.005
    assert np.abs(steps - np.round(steps)).max() < 1e-6
    coil = values[fresh[:, COIL], COIL]
    assert len(coil) == 50 and np.all(coil % 0.25 == 0) and fresh[:, POSITION].all()
    assert status[-1, COIL] == OK and status[-1, ROLE["supply_v"]] == ABSENT
    settled = values[2000:, POSITION]
    assert 0.005 < settled.std() < 0.02  # 0.01 um of noise in the plant file


def test_a_clock_that_jumps_moves_the_plants_time_not_its_state(tmp_path):
    backend = simulated(tmp_path)
    play(backend, 100)
    before = backend.rig.stepper.t
    backend.read(1e6)
    assert backend.rig.stepper.t - before < 0.01
    backend.read(50.0)  # and backwards
    assert backend.rig.stepper.t - before < 0.01


def test_slips_are_caught_up(tmp_path):
    backend = simulated(tmp_path)
    backend.read(0.0)
    before = backend.rig.stepper.t
    backend.read(0.025)
    assert backend.rig.stepper.t - before == pytest.approx(0.025)


def test_not_finite_or_not_enabled_is_no_drive(tmp_path):
    backend = simulated(tmp_path)
    for drive, enable in ((math.nan, True), (math.inf, True), (0.3, False)):
        backend.read(0.0)
        backend.write(drive, enable)
        assert backend._drive == 0.0
    backend.write(0.3, True)
    assert backend.read(0.001).value[STATE] == AMP_ENABLED
    backend.close()
    assert backend.read(0.002).value[STATE] == AMP_DISABLED


@pytest.mark.parametrize(
    "hal,message",
    [
        ({"drive_input": "drivee"}, "no input 'drivee'.*did you mean 'drive'"),
        ({"inputs": None}, "hal.inputs must say what air is"),
        ({"inputs": yamlfile.loads("{aire: {mean: 1}}")}, "no free input 'aire'.*did you mean 'air'"),
        ({"inputs": yamlfile.loads("{air: {meen: 1}}")}, "1:7: air: 'mean' is missing"),
        (
            {"inputs": yamlfile.loads("{air: {mean: 1, swinge: 2}}")},
            "unknown key 'swinge' \\(did you mean 'swing'",
        ),
        ({"roles": {"coil_c": "coill_c"}}, "'coill_c' is no role.*did you mean 'coil_c'"),
        ({"roles": {"koil": "coil_c"}}, "no output 'koil'"),
    ],
)
def test_mistakes_in_the_simulated_rig_are_named(tmp_path, hal, message):
    with pytest.raises(InputError, match=message):
        make_backend(make_settings(tmp_path, **hal))


class Source:
    """A back end whose position counts its ticks; the coil has a new reading in every tenth."""

    def __init__(self):
        self.sample, self.k, self.told = Sample(), 0, []

    def open(self):
        pass

    def read(self, now_s):
        s = self.sample
        s.fresh[:] = False
        for role, every in ((POSITION, 1), (COIL, 10), (STATE, 1)):
            if self.k % every == 0:
                s.value[role], s.time_s[role], s.fresh[role], s.status[role] = self.k, now_s, True, OK
        self.k += 1
        return s

    def write(self, drive, enable):
        self.told.append((drive, enable))

    def close(self):
        pass

    def problem(self, role):
        return ""

    def counters(self):
        return {}


def spoiled(text, ticks=100):
    source = Source()
    backend = FaultInjector(source, schedule([yamlfile.loads(text)]), seed=3)
    backend.open()
    return *play(backend, ticks, start_s=50.0), source, backend


def test_drop_holds_the_value_goes_stale_and_comes_back():
    v, f, s, _, _ = spoiled("{kind: drop, role: position_um, at_s: 0.02, for_s: 0.06, stale_after_s: 0.02}")
    assert np.all(v[20:80, POSITION] == 19) and not f[20:80, POSITION].any()
    assert np.all(s[20:39, POSITION] == OK) and np.all(s[41:80, POSITION] == STALE)
    assert np.all(v[80:, POSITION] == np.arange(80, 100)) and np.all(s[80:, POSITION] == OK)


def test_drop_by_chance_loses_about_that_share():
    _, f, _, _, _ = spoiled("{kind: drop, role: position_um, probability: 0.3}", 2000)
    assert 0.25 < 1 - f[:, POSITION].mean() < 0.35


def test_delay():
    v, f, _, _, _ = spoiled("{kind: delay, role: position_um, by: 0.03}")
    assert np.isnan(v[:30, POSITION]).all()
    assert np.all(v[30:, POSITION] == np.arange(70)) and not f[:30, POSITION].any() and f[30:, POSITION].all()


def test_freeze_nan_step_drift_set_duplicate_error():
    v, f, _, _, _ = spoiled("{kind: freeze, role: position_um, at_s: 0.01, for_s: 0.05}")
    assert np.all(v[10:60, POSITION] == 10) and f[10:60, POSITION].all() and v[60, POSITION] == 60
    v, _, s, _, _ = spoiled("{kind: nan, role: position_um, at_s: 0.01, for_s: 0.05}")
    assert np.isnan(v[10:60, POSITION]).all() and np.all(s[:, POSITION] == OK) and v[60, POSITION] == 60
    v, _, _, _, _ = spoiled("{kind: step, role: coil_c, at_s: 0.01, by: 5}")
    assert v[9, COIL] == 0 and np.all(v[10:20, COIL] == 15) and v[99, COIL] == 95
    v, _, _, _, _ = spoiled("{kind: drift, role: position_um, by: 1000}")
    assert v[50, POSITION] == pytest.approx(100)
    v, _, _, _, _ = spoiled("{kind: set, role: position_um, by: -3}")
    assert np.all(v[:, POSITION] == -3)
    v, f, _, _, _ = spoiled("{kind: duplicate, role: coil_c}")
    assert f[:, COIL].all() and v[15, COIL] == 10
    v, f, s, _, b = spoiled("{kind: error, role: [coil_c, position_um], at_s: 0.05}")
    assert np.all(s[50:, [COIL, POSITION]] == ERROR) and not f[50:, COIL].any() and s[50, STATE] == OK
    assert "injected fault" in b.problem("coil_c")


def test_swap_exchanges_two_sensors_and_nothing_else():
    v, f, _, _, _ = spoiled("{kind: swap, role: [position_um, coil_c], at_s: 0.05}")
    assert np.array_equal(v[50:, COIL], np.arange(50, 100)) and np.all(v[50:60, POSITION] == 50)
    assert f[50:, COIL].all() and f[50:, POSITION].sum() == 5


def test_corrupt_changes_one_bit_and_is_seeded():
    text = "{kind: corrupt, role: position_um, probability: 0.5}"
    v, _, _, _, _ = spoiled(text)
    changed = v[:, POSITION].view(np.uint64) ^ np.arange(100.0).view(np.uint64)
    bits = np.array([int(c).bit_count() for c in changed])
    assert set(bits) == {0, 1} and 30 < bits.sum() < 70
    assert np.array_equal(v, spoiled(text)[0], equal_nan=True)


def test_disconnect_silences_the_amplifier_and_comes_back():
    _, _, s, source, _ = spoiled("{kind: disconnect, role: all, at_s: 0.03, for_s: 0.04}")
    assert np.all(s[30:70, [POSITION, COIL, STATE]] == ERROR) and np.all(s[30:70, AIR] == ABSENT)
    assert source.told[30:70] == [(0.0, False)] * 40 and source.told[70] == (0.2, True)
    assert np.all(s[70:, POSITION] == OK)


def test_a_stuck_amplifier_drives_whatever_it_is_told():
    *_, source, _ = spoiled("{kind: stuck, at_s: 0.05, by: 0.7}")
    assert source.told[49] == (0.2, True) and source.told[50:] == [(0.7, True)] * 50


@pytest.mark.parametrize(
    "text,message",
    [
        ("{kind: drp, role: coil_c}", "'drp' is not one of.*did you mean 'drop'"),
        ("{kind: drop}", "'role' is missing"),
        ("{kind: drop, role: coil}", "'coil' is no role"),
        ("{kind: step, role: coil_c}", "'by' is missing"),
        ("{kind: delay, role: coil_c, by: -1}", "above 0"),
        ("{kind: swap, role: coil_c}", "two roles"),
        ("{kind: drop, role: coil_c, probability: 2}", "outside 0 .. 1"),
        ("{kind: drop, role: coil_c, at: 1}", "unknown key 'at' \\(did you mean 'at_s'"),
    ],
)
def test_mistakes_in_a_schedule_are_named(text, message):
    with pytest.raises(InputError, match=message):
        schedule([yamlfile.loads(text)])


def test_the_backend_of_the_settings_is_wrapped_where_faults_are_listed(tmp_path):
    faults = (yamlfile.loads("{kind: nan, role: position_um}"),)
    backend = make_backend(make_settings(tmp_path, faults=faults))
    backend.open()
    assert math.isnan(backend.read(0.0).value[POSITION])


def test_a_tick_makes_no_arrays(tmp_path):
    """The same sample, the same arrays, tick after tick."""
    backend = simulated(tmp_path)
    first = backend.read(0.0)
    arrays = [id(getattr(first, n)) for n in Sample.__slots__]
    for k in range(1, 50):
        assert backend.read(k * 0.001) is first
    assert [id(getattr(first, n)) for n in Sample.__slots__] == arrays
    assert len(ROLES) == len(first.value)


def test_settings_without_a_backend_are_refused():
    with pytest.raises(ValueError, match="simulated or devices"):
        make_backend(SimpleNamespace(hal=SimpleNamespace(backend="other"), path=str(Path())))
