"""Run the scenarios and write what was seen behind the wire.

`python -m tests.scenarios.run [--page FILE] [--only TEXT] [--times N]`: every scenario N times with the machine idle and N
times with two programs beside it that burn the processors; the page is written as far as it came.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.daemon.process import ROOT, wait
from tests.scenarios.plant import UM_PER_A
from tests.scenarios.rigs import CURRENT_TOLERANCE_A, Rigs, write_rig
from tests.scenarios.table import SAYS, SCENARIOS, SLACK_S, TRIPS, Scenario

HEAL_S = 30.0  # a reconnection takes a second; the machine may be loaded
JUMP_UM = 2.0  # arming moves the stage by less, seen for SETTLE_S
SETTLE_S = 0.3
NAMED_S = 0.5  # after the limit: the state and the fault are asked for over a socket
HELD_UM = 3.0  # a stage that is held stays this near


WIRE_PRIORITY = 60  # below the bench's and the loop's
TRIES = 6  # runs of a scenario, where the machine stood still in the ones before
STOOD_S = 0.03  # a bench that was late by so much was no bench: its devices fell silent


class Wrong(AssertionError):
    """Something else happened than must."""


class Stood(Wrong):
    """The machine stood still: the loop (loop_late), or the devices (the bench)."""


def _wrong(seen: dict[str, Any], found: set[str], text: str) -> Wrong:
    """Stood where the machine explains it, else Wrong."""
    if "loop_late" in found or seen["stood_s"] > STOOD_S:
        return Stood(f"{text} (the bench stood {seen['stood_s'] * 1e3:.0f} ms; {', '.join(sorted(found))})")
    return Wrong(text)


def run(scenario: Scenario, rigs: Rigs) -> str:
    """One scenario from armed to armed again; what was seen in words. Raises Wrong."""
    for _ in range(TRIES - 1):
        try:
            return _run(scenario, rigs)
        except Stood as e:
            print("again", scenario.name, "|", e, flush=True)
            _heal(scenario, rigs, tripped=True)
    return _run(scenario, rigs)


def _run(scenario: Scenario, rigs: Rigs) -> str:
    if scenario.also:
        rigs.daemon(scenario.also)
    try:
        seen = _say(scenario, rigs) if scenario.expect == SAYS else _drive(scenario, rigs)
    except Wrong:
        raise
    except AssertionError as e:  # a wait was in vain: armed, at the setpoint, driven, at rest
        found = fault_names(rigs.daemon(scenario.rig).ask("status"))
        raise _wrong(rigs.seen(scenario.rig), found, f"{e}, faults {sorted(found)}") from None
    finally:
        rigs.bench.tell("mend")
        if scenario.also:
            rigs.stop(scenario.also)
    return seen


def fault_names(status: dict[str, Any]) -> set[str]:
    """Names of the faults that a status shows."""
    return {f["name"] for f in status.get("faults", ())}


def _drive(scenario: Scenario, rigs: Rigs) -> str:
    """Arm, inject, judge behind the wire, mend, arm again."""
    name = scenario.rig
    rigs.arm(name, scenario.setpoint_um)
    daemon = rigs.daemon(name)
    pid = _victim(scenario, daemon)  # to look for it takes time
    # The bench kills, right after its mark: this program's turn may come 0.1 s later on a loaded machine.
    kill = (("kill", [pid, getattr(signal, scenario.kill[1])]),) if scenario.kill else ()
    rigs.bench.tell("inject", (*scenario.steps, *kill), name)
    if scenario.then_um is not None:
        daemon.ask("setpoint", value=scenario.then_um)
    seen = _trip(scenario, rigs) if scenario.expect == TRIPS else _ride(scenario, rigs)
    return f"{seen}; {_heal(scenario, rigs, scenario.expect == TRIPS)}"


def _victim(scenario: Scenario, daemon: Any) -> int:
    """The process that the scenario kills."""
    return daemon.child("loop") if scenario.kill and scenario.kill[0] == "loop" else daemon.process.pid


def _trip(scenario: Scenario, rigs: Rigs) -> str:
    """The coil is off in time, by a fault that names the cause, and does not come on again by itself."""
    name, found = scenario.rig, set[str]()
    limit_s = 2 * scenario.within_s + 3.0  # how long we look; the limit is judged below
    try:
        seen = rigs.until(name, lambda s: not s["driven"], limit_s, "coil off")
    except AssertionError:
        seen = rigs.seen(name)
        raise Wrong(f"still driven after {seen['seconds']:.1f} s, {seen['i_a']:.2f} A") from None
    if not scenario.kill:

        def named() -> bool:
            status = rigs.daemon(name).ask("status")
            found.update(fault_names(status))
            return status["state"] == "FAULT" and bool(found & set(scenario.faults))

        try:
            wait(named, "named", scenario.within_s + NAMED_S)
        except AssertionError:
            state = rigs.daemon(name).ask("status")["state"]
            raise Wrong(
                f"off after {seen['off_after_s']:.3f} s, but {state}, faults {sorted(found)}"
            ) from None
    seen = rigs.until(name, lambda s: s["seconds"] > scenario.within_s + scenario.hold_s, 20.0, "watched")
    if seen["driven"] or seen["ons"]:
        raise Wrong(f"driven again by itself, {seen['i_a']:.2f} A")
    if seen["off_after_s"] > scenario.within_s:
        raise _wrong(seen, found, f"off only after {seen['off_after_s']:.3f} s")
    first = sorted(found & set(scenario.faults))
    return f"off after {seen['off_after_s']:.3f} s" + (f", `{'`, `'.join(first)}`" if first else "")


def _ride(scenario: Scenario, rigs: Rigs) -> str:
    """Driven without a pause, ARMED, held; where a warning must be shown, it is."""
    name, found = scenario.rig, set[str]()
    daemon = rigs.daemon(name)
    while (seen := rigs.seen(name))["seconds"] < scenario.watch_s:
        status = daemon.ask("status")
        found |= fault_names(status)
        if status["state"] != "ARMED" or not seen["driven"]:
            text = f"{status['state']} after {seen['seconds']:.2f} s: {', '.join(sorted(found))}"
            raise _wrong(rigs.seen(name), found, text)
    if seen["ons"] or seen["far_um"] > HELD_UM:
        raise _wrong(seen, found, f"driven with {seen['ons']} pauses, moved by {seen['far_um']:.1f} um")
    if scenario.faults and not found & set(scenario.faults):
        raise Wrong(f"not noticed: faults {sorted(found)}")
    return f"driven throughout, moved by {seen['far_um']:.1f} um" + (
        f", `{'`, `'.join(sorted(found))}`" if found else ""
    )


def _heal(scenario: Scenario, rigs: Rigs, tripped: bool) -> str:
    """Mended, nothing arms by itself; a person arms, without a jump."""
    name = scenario.rig
    if scenario.kill:
        ended = rigs.daemons[name]
        wait(lambda: ended.process.poll() is not None, "the daemon's end", HEAL_S)
        rigs.stop(name)
    rigs.bench.tell("mend")
    if tripped:
        rigs.bench.tell("mark", name)
        daemon = rigs.daemon(name)

        def ready() -> bool:
            daemon.ask("disarm")
            return daemon.ask("status")["state"] == "READY" and rigs.seen(name)["operational"]

        try:
            wait(ready, "READY", HEAL_S)
        except AssertionError:
            status = daemon.ask("status")
            raise Wrong(f"does not heal: {status['state']}, {sorted(fault_names(status))}") from None
        if rigs.seen(name)["ons"]:
            raise Wrong("driven again after mending, not armed")
    else:
        wait(lambda: rigs.daemon(name).ask("disarm")["ok"], "disarmed", HEAL_S)
    rigs.until(name, lambda s: not s["driven"] and abs(s["x_um"]) < 0.3, 5.0, "at rest")
    rigs.bench.tell("mark", name)
    rigs.arm(name)
    seen = rigs.until(name, lambda s: s["driven"], 5.0, "driven")
    begun = seen["seconds"]
    seen = rigs.until(name, lambda s: s["seconds"] > begun + SETTLE_S, 5.0, "settled")
    if seen["far_um"] > JUMP_UM or not seen["driven"]:
        status = rigs.daemon(name).ask("status")
        text = (
            f"armed again: moved by {seen['far_um']:.1f} um, {status['state']}, {sorted(fault_names(status))}"
        )
        raise _wrong(seen, fault_names(status), text)
    return f"armed again, moved by {seen['far_um']:.1f} um"


def _say(scenario: Scenario, rigs: Rigs) -> str:
    """A command's words."""
    config = rigs.configs[scenario.rig]
    if scenario.command == "status":
        rigs.daemon(scenario.rig)
    else:
        rigs.stop(scenario.rig)
    rigs.bench.tell("inject", scenario.steps, scenario.rig)
    command = scenario.command.partition("-")[0]
    try:
        if scenario.command == "doctor-50":
            write_rig(rigs.folder, scenario.rig, rigs.bench.ports[0], METER_HZ=50)
        arguments = [str(config)] if command == "doctor" else ["--config", str(config)]
        line = [sys.executable, "-m", "thermoctl.cli", command, *arguments]
        printed = ""

        def said() -> bool:
            nonlocal printed
            done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT, timeout=30)
            printed = done.stdout + done.stderr
            return re.search(scenario.words, printed) is not None

        try:
            wait(said, "said", 8.0)
        except AssertionError:
            raise Wrong(f"`thermoctl {command}` does not say so: {printed}") from None
    finally:
        write_rig(rigs.folder, scenario.rig, rigs.bench.ports[0])
    found = next(text for text in printed.splitlines() if re.search(scenario.words, text))
    return f"`{' '.join(found.split())[:140]}`"


@contextmanager
def burners(number: int) -> Iterator[None]:
    """So many programs that do nothing but burn a processor each."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def hasten(policy: int = os.SCHED_FIFO) -> None:
    """Give the kernel's workers that carry bytes through a pseudo-terminal a real-time priority; SCHED_OTHER takes it back.

    A wire does not wait for other programs; these workers do. Needs root."""
    for comm in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):
            if comm.read_text().startswith("kworker/u"):
                priority = os.sched_param(WIRE_PRIORITY if policy == os.SCHED_FIFO else 0)
                os.sched_setscheduler(int(comm.parent.name), policy, priority)


Seen = dict[tuple[str, str], list[tuple[bool, str]]]


def run_all(scenarios: list[Scenario], times: int, seen: Seen, each: Any) -> None:
    """All of them, idle and loaded, into `seen`; `each()` after every one."""
    for _ in range(times):
        for beside, number in (("idle", 0), ("loaded", 2)):
            with tempfile.TemporaryDirectory() as folder, burners(number):
                rigs = Rigs(Path(folder))
                try:
                    for scenario in sorted(scenarios, key=lambda s: s.rig):
                        hasten()
                        try:
                            result = True, run(scenario, rigs)
                        except Exception as e:  # a scenario that breaks is a scenario that is wrong
                            result = False, f"{'' if isinstance(e, Wrong) else 'broken: '}{e}"
                            rigs.stop(scenario.rig)
                        seen.setdefault((scenario.name, beside), []).append(result)
                        print(
                            "ok   " if result[0] else "WRONG",
                            beside,
                            scenario.name,
                            "|",
                            result[1],
                            flush=True,
                        )
                        each()
                finally:
                    hasten(os.SCHED_OTHER)
                    rigs.close()


def expected(scenario: Scenario) -> str:
    """What must happen, in words."""
    if scenario.expect == TRIPS:
        return f"coil off within {scenario.within_s:.2f} s"
    if scenario.expect == SAYS:
        return f"`thermoctl {scenario.command.partition('-')[0]}` says so"
    return scenario.expect


THRESHOLDS = f"""
## From where on a fault can be noticed

- **TPDO frozen.** A frame with the state only is the same while all is well. Map an analogue object beside it (DC link,
  current) and set `protection.frozen_s.supply_v`: its noise stands still when the drive repeats an old frame. It is a warning
  unless `supply_v` is required. That the drive itself stopped is found by the current and by the following error.
- **Half the current.** The loop asks for twice as much, so the current misses by half of what is asked. It is noticed where
  that is above `protection.current_tolerance_a`: with {CURRENT_TOLERANCE_A:g} A from {CURRENT_TOLERANCE_A * UM_PER_A:.0f} um on,
  with the default of 0.1 A from {0.1 * UM_PER_A:.0f} um on. The tolerance must exceed the meter's error and ramp x delay: at
  60 um/s and 0.1 s of delay {60 / UM_PER_A * 0.1:.3f} A.
- **Stage jammed.** While it holds, no reading differs from that of a free stage. It is noticed when the stage is asked to
  move, by any distance: the integrator's force grows until current and position disagree.
- **Two drives with one address.** Set-up counts the answers to its requests, and a drive that is switched on later is seen
  by its boot-up message. Two that are already running cannot be told apart by heartbeats.
- **A rate below `rate_hz`.** `status` and `doctor` say so below half of it. A busy machine reaches 0.8, a wrong setting of a
  device 0.1 to 0.3.
"""


def page(scenarios: list[Scenario], seen: Seen, date: str, load: float) -> str:
    """The table as Markdown."""
    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    made = [[seen.get((s.name, beside), []) for beside in ("idle", "loaded")] for s in scenarios]
    right = sum(all(runs and all(ok for ok, _ in runs) for runs in both) for both in made)
    fewest = min((len(runs) for both in made for runs in both), default=0)
    text = f"""<!-- Written by `make scenarios`; every figure was measured by tests/scenarios. -->
# Fault scenarios at the wire

{right} of {len(scenarios)} scenarios are as they must be in every run, {fewest} runs or more idle and loaded. Measured {date} on {os.cpu_count()} x \
{model[1] if model else platform.machine()}, Linux {platform.release()}.

The daemon runs as a program with its own drivers. The devices at the other end of its wires are emulators that
were written from the protocols' descriptions and share no code with the drivers. "Off" is judged behind the
wire: the drive's output stage is off and the coil carries less than 20 mA. A limit is the sum of the configured
times and {SLACK_S} s for the ways there and back. After each scenario the device is mended; the coil must stay off
until someone arms; arming moves the stage by less than {JUMP_UM:g} um. "Loaded": two programs burn both processors.
"Idle": without them; the load average of other jobs was {load:.1f}. A run in which the loop or the emulators stood
still with the machine is void and made again, at most {TRIES - 1} times. Each cell shows one run, a wrong one first.
"""
    for title, group in (("Rig A", "A"), ("Rig B", "B")):
        text += f"\n## {title}\n\n| scenario | stands for | expected | seen idle | seen loaded |\n| --- | --- | --- | --- | --- |\n"
        for s in (s for s in scenarios if s.rig == group):
            cells = [_cell(seen.get((s.name, beside), [])) for beside in ("idle", "loaded")]
            text += f"| {s.name} | {s.bad} | {expected(s)} | {' | '.join(cells)} |\n"
    return text + THRESHOLDS


def _cell(results: list[tuple[bool, str]]) -> str:
    if not results:
        return "not run"
    wrong = [text for ok, text in results if not ok]
    text = (
        f"**wrong** ({len(wrong)} of {len(results)}): {wrong[0]}"
        if wrong
        else max(text for _, text in results)
    )
    return text.replace("|", "\\|")[:300]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--only", default="", help="scenarios whose name holds this regular expression")
    parser.add_argument("--times", type=int, default=2)
    options = parser.parse_args()
    scenarios = [s for s in SCENARIOS if re.search(options.only, s.name)]
    seen: Seen = {}
    with suppress(OSError):  # needs root: other sessions' jobs take less of the processors
        Path("/proc/self/autogroup").write_text("-15")
    load = os.getloadavg()[0]

    def write() -> None:
        if options.page:
            options.page.write_text(page(scenarios, seen, time.strftime("%Y-%m-%d"), load))

    run_all(scenarios, options.times, seen, write)
    wrong = sorted({name for (name, _), results in seen.items() if not all(ok for ok, _ in results)})
    print(
        f"{len(scenarios) - len(wrong)} of {len(scenarios)} as they must be"
        + (f"; wrong: {wrong}" if wrong else "")
    )
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
