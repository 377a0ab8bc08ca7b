"""Both rigs armed on slow, jittering Modbus: answers after 5 to 300 ms, one in a hundred lost. No trip is allowed.

`python -m tests.scenarios.armed_hour [--minutes M] [--page FILE]`. Limits are those of config/wire.yaml. Only the ages are
longer, since a reading of a device that may take 0.3 s for each of two answers cannot be younger.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import sys
import tempfile
import time
from pathlib import Path

from tests.scenarios.rigs import CURRENT_TOLERANCE_A, Rigs, write_rig
from tests.scenarios.run import STOOD_S, fault_names

SLOWEST_S, FASTEST_S, LOSS = 0.3, 0.005, 0.01
# Two answers of 0.3 s, one of them lost and its 0.5 s waited for, three times in a row: (3 x 0.5 + 2 x 0.3) s and room.
STALE_S, TIMEOUT_S = 3.0, 0.5
MOVE_EVERY_S, TRAVEL_UM = 20.0, (60.0, -60.0, 0.0)
PRIORITY = 20  # of all programs of both rigs: other jobs of a shared machine do not count
MOST_STALLS = 2  # a machine that stands still more often proves nothing about the rigs


def slow_rig(rigs: Rigs, name: str) -> None:
    """The rig's file for slow Modbus, with the limits as shipped."""
    port = rigs.bench.ports["AB".index(name)]
    path = write_rig(
        rigs.folder,
        name,
        port,
        TC_STALE=STALE_S,
        METER_STALE=STALE_S,
        TC_TIMEOUT=TIMEOUT_S,
        METER_TIMEOUT=TIMEOUT_S,
    )
    text = path.read_text().replace("setpoint_rate_um_s: 60", "setpoint_rate_um_s: 1 mm/min")
    text = text.replace(f"\n  current_tolerance_a: {CURRENT_TOLERANCE_A}", "")
    slow = f"{{position_um: 0.1, voltage_v: {STALE_S}, current_a: {STALE_S}, air_c: {STALE_S}, temperatures_c: {STALE_S}}}"
    text, count = re.subn(r"stale_s: \{.*", f"stale_s: {slow}", text)
    assert count == 1
    path.write_text(text)


def hour(minutes: float) -> tuple[bool, str]:
    """(armed throughout, what was seen as one line of Markdown a rig)."""
    with tempfile.TemporaryDirectory() as folder:
        rigs = Rigs(Path(folder))
        try:
            for name in "AB":
                slow_rig(rigs, name)
                for registers in (f"{name}.tc", f"{name}.meter"):
                    spoilt = [
                        (f"{registers}.delays_s", [FASTEST_S]),
                        (f"{registers}.jitter_s", SLOWEST_S - FASTEST_S),
                    ]
                    rigs.bench.tell("inject", [*spoilt, (f"{registers}.loss", LOSS)], name)
                rigs.arm(name)
                rigs.until(name, lambda s: s["driven"], 5.0, "driven")
                rigs.bench.tell("mark", name)
            return _watch(rigs, 60.0 * minutes)
        finally:
            rigs.close()


def _watch(rigs: Rigs, seconds: float) -> tuple[bool, str]:
    begin, moves, stood, wrong, still_until, tripped = time.monotonic(), 0, 0, "", 0.0, 0.0
    warned: dict[str, set[str]] = {"A": set(), "B": set()}
    while time.monotonic() < begin + seconds and not wrong:
        if time.monotonic() > begin + moves * MOVE_EVERY_S:
            for daemon in rigs.daemons.values():
                daemon.ask("setpoint", value=TRAVEL_UM[moves % len(TRAVEL_UM)])
            moves += 1
            print(
                f"{time.monotonic() - begin:7.0f} s",
                {n: rigs.seen(n)["asked"] for n in "AB"},
                warned,
                flush=True,
            )
        for name, daemon in rigs.daemons.items():
            status = daemon.ask("status")
            seen = rigs.seen(name)
            if status["state"] != "ARMED" or not seen["driven"] or seen["ons"]:
                why = (
                    f"{status['state']} after {time.monotonic() - begin:.0f} s: {sorted(fault_names(status))}"
                )
                still = seen["stood_s"] > STOOD_S or time.monotonic() < still_until
                if still and time.monotonic() > tripped + 1.0:  # else the other rig has shown this stall
                    stood, tripped = stood + 1, time.monotonic()
                if not still or stood > MOST_STALLS:
                    wrong = f"rig {name}: {why}"
                    break
                print(
                    f"the machine stood, rig {name} {why}, bench {seen['stood_s'] * 1e3:.0f} ms", flush=True
                )
                with contextlib.suppress(
                    AssertionError
                ):  # it stood again meanwhile: the next look finds that
                    rigs.arm(name)
                    rigs.until(name, lambda s: s["driven"], 5.0, "driven")
                    rigs.bench.tell("mark", name)
            elif seen["stood_s"] > STOOD_S:
                still_until = time.monotonic() + 1.0  # what it brings shows within this
                rigs.bench.tell("mark", name)
            warned[name] |= fault_names(status)
        time.sleep(0.1)  # how often we look; the coil is watched every millisecond by the bench
    lines = []
    for name, daemon in rigs.daemons.items():
        seen = rigs.seen(name)
        slips = daemon.ask("status").get("slips")
        lines.append(
            f"| {name} | {(time.monotonic() - begin) / 60:.1f} min | {seen['asked']} | {seen['lost']} | {moves} | {slips} | {stood} | "
            f"{', '.join(sorted(warned[name])) or 'none'} | {'**' + wrong + '**' if wrong else 'no other trip' if stood else 'driven throughout'} |"
        )
    return not wrong, "\n".join(lines)


def main() -> int:
    """The command line."""
    with contextlib.suppress(PermissionError):  # other jobs of the machine are no part of the trial
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    good, lines = hour(options.minutes)
    head = (
        "| rig | armed | requests | answers lost | moves | late ticks | times the machine stood | faults shown | coil |\n"
        + "| --- " * 9
        + "|\n"
    )
    print(head + lines)
    if options.page:
        options.page.write_text(
            "<!-- Written by `make armed-hour`; measured by tests/scenarios/armed_hour.py. -->\n# Armed on slow Modbus\n\n"
            f"Both rigs of tests/scenarios armed for {options.minutes:g} minutes ({time.strftime('%Y-%m-%d')}, "
            f"{os.cpu_count()} processors). Each Modbus answer takes {FASTEST_S * 1e3:.0f} to {SLOWEST_S * 1e3:.0f} ms; one in "
            f"{1 / LOSS:.0f} is lost. Limits are those of config/wire.yaml. Readings of these devices may be {STALE_S:g} s old, "
            "since two slow answers and a lost one take that long. The stage moves every 20 s. The coil is watched behind "
            "the wire every millisecond. All programs run at real-time priority. "
            f"Where the machine stood still (the emulators fell silent for {STOOD_S * 1e3:.0f} ms) the "
            f"rig is armed again and this is counted; {MOST_STALLS} times at most.\n\n{head}{lines}\n"
        )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
