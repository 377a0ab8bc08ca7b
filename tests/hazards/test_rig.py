"""The amplifier, the stage, the coil, the clock and the people, in simulated time."""

import dataclasses

import numpy as np
import pytest

from tests.hazards.harness import ROWS, HazardRig, Row, say
from thermoctl.control import arming
from thermoctl.daemon.reload import reload_settings
from thermoctl.daemon.tick import loop as loops
from thermoctl.daemon.tick.assemble import law_parameters
from thermoctl.daemon.tick.ring import Histogram
from thermoctl.files.yamlfile import InputError


def finish(rig, hazard, limit, ticks, found, way):
    say("Rig", hazard, limit, ticks, found, way, rig.comes_back(60.0))


@pytest.mark.parametrize("amperes", [0.1, -0.3, 1.5])
def test_coil_stuck_on_while_idle(rig, amperes):
    """The output stage drives although it is disabled: software can only say so, and keep the rig from being armed."""
    rig.until(lambda row: rig.state == "READY", 5.0)
    rig.inject("stuck", by=amperes)
    limit = 520
    ticks, found, way = rig.detect({"coil_stuck_on"}, limit)
    for name in ("arm", "disarm", "arm"):
        rig.command(name)
        rig.tick(5)
        assert rig.state == "FAULT"
    finish(rig, f"amplifier: {amperes:g} A while disabled", limit, ticks, found, way)


@pytest.mark.parametrize("amperes", [1.5, -1.5, 0.0])
def test_runaway(rig, amperes):
    """The amplifier drives what it likes while armed: caught by its current before the stage has gone far; then the
    stage follows the amplifier, which only its own supply can stop."""
    rig.ready_to_be_spoiled(100.0)
    rig.tick(4000)
    rig.inject("stuck", by=amperes)
    ticks, found, way = rig.detect({"amplifier_not_following", "following_error", "position_disagrees"}, 20)
    finish(rig, f"runaway: {amperes:g} A whatever is asked for", 20, ticks, found, way)


def test_encoder_counts_backwards(rig):
    """Positive feedback from arming on: the stage may not go further than the following error allows and a little more."""
    inner = rig.backend.read

    def backwards(now_s):
        sample = inner(now_s)
        sample.value[0] = -sample.value[0]
        return sample

    rig.backend.read = backwards
    rig.arm()
    rig.command("setpoint", 5.0)
    way, limit, ticks = 0.0, 60, 0
    while ticks < limit:
        ticks += 1
        rig.tick()
        way = max(way, abs(rig.output_um))
        if rig.state == "FAULT":
            break
    assert rig.state == "FAULT" and rig["drive"] == 0.0 and way < 100.0, (rig.state, way)
    found = rig.faults & {"position_disagrees", "following_error", "drive_saturated"}
    assert found
    del rig.backend.read
    finish(rig, "runaway: the encoder counts backwards", limit, ticks, found, way)


def test_blocked_stage(rig):
    """The stage does not move any more: position held, the controller pushes."""
    rig.ready_to_be_spoiled(100.0)
    held, inner, k = rig["position_um"], rig.backend.read, [0]

    def blocked(now_s):
        sample = inner(now_s)
        k[0] += 1
        sample.value[0] = held + 0.005 * (k[0] % 3)
        return sample

    rig.backend.read = blocked
    ticks, found, way = rig.detect({"following_error", "position_disagrees", "drive_saturated"}, 400)
    del rig.backend.read
    finish(rig, "following error: blocked stage", 400, ticks, found, way)


@pytest.mark.parametrize("setpoint_um", [-240.0, 200.0, 240.0])
def test_a_disarm_far_from_rest_is_no_fault(rig, setpoint_um):
    """The stage that sprang back was told as position_disagrees, and nobody could arm meanwhile."""
    rig.arm()
    rig.command("setpoint", setpoint_um)
    rig.tick(16_000)  # at 1 mm a minute
    assert rig.state == "ARMED" and abs(rig["compensated_um"] - setpoint_um) < 1.0
    rig.command("disarm")
    seen = set()
    for _ in range(1000):
        rig.tick()
        seen |= rig.faults
    assert rig.state == "READY" and not seen


def test_over_temperature_by_rate(quick):
    """A coil that heats ten times faster than it may trips long before its limit of temperature."""
    p = dataclasses.replace(law_parameters(quick), coil_rate_k_s=0.5, coil_rate_time_s=3.0)
    rig = HazardRig(quick, parameters=p)
    rig.ready_to_be_spoiled(5.0)
    rig.inject("drift", "coil_c", by=5.0)
    ticks, found, way = rig.detect({"coil_heating_rate"}, 500)
    assert rig["coil_c"] < 26.0
    finish(rig, "coil: over-temperature by rate, 5 K/s", 500, ticks, found, way)
    rig.close()


def test_over_temperature(quick):
    p = dataclasses.replace(
        law_parameters(quick),
        coil_limit_c=30.0,
        innovation_limit_c=99.0,
        drift_limit_c=99.0,
        coil_rate_k_s=99.0,
    )
    rig = HazardRig(quick, parameters=p)
    rig.ready_to_be_spoiled(5.0)
    rig.inject("drift", "coil_c", by=5.0)
    ticks, found, way = rig.detect({"coil_overtemperature", "coil_overtemperature_model"}, 1700)
    finish(rig, "coil: over-temperature, +8 K at 5 K/s", 1700, ticks, found, way)
    rig.close()


def test_compensation_out_of_bound(quick):
    rig = HazardRig(quick, parameters=dataclasses.replace(law_parameters(quick), bound_um=3.0))
    rig.arm()
    rig.command("setpoint", 250.0)
    ticks, found, way = rig.detect({"compensation_bound"}, 15000)
    assert abs(rig["compensation_um"]) <= 3.0 + 1e-9
    rig.injector.faults.clear()
    say("Rig", "compensation: estimate beyond its bound of 3 um", 15000, ticks, found, way, None)
    rig.close()


def test_setpoint_flood(rig):
    """A new setpoint in every tick, as far apart as may be, and some that are no numbers: the reference keeps its speed."""
    rig.ready_to_be_spoiled(0.0)
    random, speed, before, behind = np.random.default_rng(2), 0.0, rig["reference_um"], 0.0
    for k in range(3000):
        rig.command("setpoint", [250.0, -250.0, float(random.uniform(-1e9, 1e9)), np.nan, np.inf][k % 5])
        rig.tick()
        speed, before = max(speed, abs(rig["reference_um"] - before) / 1e-3), rig["reference_um"]
        behind = max(behind, abs(rig["compensated_um"] - rig["reference_um"]))
        assert rig.state == "ARMED" and not rig.faults
    assert speed <= 1000 / 60 * (1 + 1e-9) and behind < 1.0
    ROWS.append(
        Row(
            "Rig",
            "setpoint flood: one a tick, to and fro, NaN and infinite",
            "16.67 um/s, 1 um behind",
            f"{speed:.2f} um/s, {behind:.2f} um behind",
            "drives on",
            "refused outside the limits by the command socket",
        )
    )


def test_reload_to_nonsense(quick, rig):
    """Each damaged configuration is refused whole, with its place; what is in force stays, and the stage stays."""
    from pathlib import Path

    path, good = Path(quick.path), Path(quick.path).read_text()
    rig.ready_to_be_spoiled(5.0)
    generation, refused = rig["generation"], 0
    try:
        for old, new in (
            ("kp: 0.01", "kp: -1"),
            ("kp: 0.01", "kp: .nan"),
            ("kp: 0.01", "kp: [1]"),
            ("control:", "contrl:"),
            ("ti_s: 0.004", "ti_s: 0"),
            ("output_limit: 1.5", "output_limit: 1e99"),
            ("\nrig:", "\n{{{"),
            ("setpoint_low_um: -250", "setpoint_low_um: 999"),
            ("required: [", "required: [nothing, "),
            ("\nrig:", "\n\0"),
        ):
            path.write_text(good.replace(old, new, 1))
            with pytest.raises(InputError, match="rig.yaml"):
                reload_settings(quick, quick)
            refused += 1
            rig.tick(20)
        path.write_text(
            good.replace("kp: 0.01", "kp: 0.008").replace("moving_average: 4", "moving_average: 9")
        )
        stood = rig["reference_um"] - rig["compensated_um"]
        rig.reload(reload_settings(quick, quick)[1])
        worst = 0.0
        for _ in range(300):
            rig.tick()
            worst = max(worst, abs(rig["reference_um"] - rig["compensated_um"] - stood))
    finally:
        path.write_text(good)
    assert rig.state == "ARMED" and not rig.faults and rig["generation"] == generation + 1 and worst < 0.5
    ROWS.append(
        Row(
            "Rig",
            "reload: ten damaged configurations, then a good one",
            "all refused; 0.5 um",
            f"{refused} refused; {worst:.2f} um",
            "drives on",
            "file:line:column, what was expected",
        )
    )


def test_clock_step(rig):
    """NTP sets the wall clock by an hour, to and fro: the loop runs on the monotonic one and does not notice."""
    rig.ready_to_be_spoiled(5.0)
    step, worst, t_s = [0.0], 0.0, rig["t_s"]
    rig.rig.wall_s = lambda: rig.now_s + step[0]
    for k in range(2000):
        step[0] = (0.0, 3600.0, -3600.0)[k // 100 % 3]
        rig.tick()
        worst = max(worst, abs(rig["reference_um"] - rig["compensated_um"]))
        assert rig.state == "ARMED" and not rig.faults and rig["t_s"] > t_s
        t_s = rig["t_s"]
    assert worst < 0.5
    ROWS.append(
        Row(
            "Clock",
            "wall clock set by an hour, to and fro",
            "no fault, 0.5 um",
            f"no fault, {worst:.2f} um",
            "drives on",
            "recorded in `wall_s`; `t_s` goes on",
        )
    )


@pytest.mark.parametrize(
    "name,gap_s", [("starved for 0.3 s", 0.3), ("stopped for 2 s", 2.0), ("suspended for an hour", 3600.0)]
)
def test_gap(rig, name, gap_s):
    """The loop did not run: the first tick after it trips; after a long gap the estimate starts anew on the coil's reading."""
    rig.ready_to_be_spoiled(5.0)
    rig.rig.tick(rig.now_s + 1e-3, gap_s, 0.0, lambda: 0)
    assert rig.state == "FAULT" and "loop_late" in rig.faults and rig["enable"] == 0.0
    rig.tick(300)
    assert abs(rig["coil_est_c"] - rig["coil_c"]) < 0.5
    say("Clock", f"the loop was {name}", 1, 1, {"loop_late"}, 0.0, rig.comes_back())


def test_a_suspend_shows_in_the_loops_own_clock(quick):
    """run_loop itself: CLOCK_BOOTTIME runs away from CLOCK_MONOTONIC; within SUSPEND_EVERY ticks dt holds the gap."""
    rig = HazardRig(quick)
    slept, rows = [0], []
    rig.rig.suspended_ns = lambda: slept[0]

    class Counters(dict):
        def __missing__(self, key):
            return 0.0

    count = Histogram(np.zeros(11, np.uint64), np.zeros(1))
    shared = type("Shared", (), {"counters": Counters(), "lateness": count, "busy": count})
    rig.rig.publish_row = lambda row: rows.append(row.copy())

    def stopping():
        if len(rows) == 40:
            slept[0] = 3600 * 10**9
        return len(rows) >= 80

    loops.run_loop(quick, shared, rig.rig, stopping)
    dt = np.array(rows)[:, loops.SIGNAL_AT["dt_s"]]
    late = np.flatnonzero(dt > 3000)
    assert len(late) == 1 and 40 <= late[0] <= 40 + loops.SUSPEND_EVERY
    rig.close()


def test_a_restart_keeps_the_estimates(quick, tmp_path):
    """Warm rig, daemon started again 30 s (of the quick rig) later: the estimate and the expansion's origin are kept; not
    where the kept ones do not fit the coil any more, are old, of another model, or damaged."""
    from thermoctl.daemon import keep

    rig = HazardRig(quick)
    rig.arm()
    rig.command("setpoint", 250.0)
    rig.tick(30000)
    expansion, model, path = rig["expansion_um"], rig.law.model, tmp_path / "x.state"
    assert abs(expansion) > 3.0 and keep.save(path, model, rig.law.snapshot())
    state, age_s, why = keep.load(path, model)
    assert why == "" and age_s < 60.0
    after = HazardRig(quick)
    after.backend.rig, after.injector.inner = rig.backend.rig, after.backend
    after.law.resume(state, 0.05)
    assert after.law.state == arming.OFF and after.law.enable == 0.0 and after.law.setpoint_um == 0.0
    after.tick(400)
    kept = after["expansion_um"] - (rig.output_um - rig.backend.rig.true("position_um"))
    cold = HazardRig(quick)
    cold.backend.rig = rig.backend.rig
    cold.tick(400)
    without = cold["expansion_um"] - (rig.output_um - rig.backend.rig.true("position_um"))
    assert after.state == "READY" and abs(kept) < 0.5 < abs(without)
    other = HazardRig(quick)  # a rig that is cold: the kept estimates do not fit
    other.law.resume(state, 0.05)
    other.tick(300)
    assert abs(other["coil_est_c"] - other["coil_c"]) < 0.6 and abs(other["expansion_um"]) < 1.0
    text = path.read_text()
    for damaged in (
        "",
        "{}",
        "[1]",
        text[:-9],
        text.replace('"version": 2', '"version": 1'),
        "x" * 99999,
        text.replace('"boot": "', '"boot": "0'),
    ):
        path.write_text(damaged)
        assert keep.load(path, model)[0] is None
    path.write_text(text)
    assert keep.load(path, dataclasses.replace(model, R_v=model.R_v, f1=0.5))[2] == "of another model"
    ROWS.append(
        Row(
            "Clock",
            "restart on a warm rig",
            "expansion within 0.5 um",
            f"{abs(kept):.2f} um (without what was kept {abs(without):.2f} um)",
            "SAFE, not armed",
            "`estimates kept=True age_s=...` in the log",
        )
    )
    for r in (rig, other):
        r.close()
