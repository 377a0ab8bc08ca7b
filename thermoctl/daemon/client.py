"""What the commands print: each function is one command of the command line, given the configuration's path.

Exit status as in cli.py. `which_rig.choose` found the configuration.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.display import fault_lines, value_lines
from thermoctl.daemon.lock import holder
from thermoctl.settings import load_settings
from thermoctl.yamlfile import InputError


def run(config: str) -> int:
    """The daemon in the foreground."""
    from thermoctl.daemon.supervisor import run as supervise

    return supervise(load_settings(config))


def service(config: str, action: str) -> int:
    """start, stop or restart."""
    from thermoctl.daemon import service as services

    return getattr(services, action)(load_settings(config))


def request(config: str, command: str, value: float | None = None, as_json: bool = False) -> int:
    """arm, disarm, setpoint or reload; 0, or 1 when the daemon refuses."""
    answer = ask(load_settings(config).socket.path, {"command": command, "value": value})
    if as_json:
        print(json.dumps(answer))
    elif not answer["ok"]:
        print(f"thermoctl: {answer['error']}", file=sys.stderr)
    elif command == "reload":
        print("applied: " + (", ".join(answer["applied"]) or "nothing changed"))
        if answer["needs_restart"]:
            print("needs a restart: " + ", ".join(answer["needs_restart"]))
    else:
        setpoint = answer.get("setpoint_um")
        held = command != "disarm" and setpoint is not None
        print(answer["state"] + (f", setpoint {setpoint:.3f} um" if held else ""))
    return 0 if answer["ok"] else 1


def status(config: str, as_json: bool = False) -> int:
    """The daemon's state; 0, or 1 when it does not run or a fault stands."""
    settings = load_settings(config)
    try:
        answer = ask(settings.socket.path, {"command": "status"})
    except InputError as e:
        if (pid := holder(settings)) is not None:
            e = InputError(f"{e.args[0]}; pid {pid} holds the rig: it starts, stops or drives it by itself")
        if as_json:
            print(json.dumps({"ok": False, "state": "OFF", "error": str(e)}))
        else:
            print(f"thermoctl: {e}", file=sys.stderr)
        return 1
    faulty = any(f["severity"] != "warning" for f in answer["faults"])
    if as_json:
        print(json.dumps(answer))
        return 1 if faulty else 0
    if not answer["ticks"]:
        print("OFF, starting")
        return 1
    print(
        f"{answer['state']}   {answer['ticks']} ticks in {answer['uptime_s']:.1f} s, {answer['slips']} slips, "
        f"busy {answer['busy_us']:.0f} us"
    )
    print("\n".join([*fault_lines(answer["faults"]), *value_lines(answer)]))
    for line in answer.get("slow", ()):
        print(line)
    if answer.get("tuning_percent") is not None:
        print(f"tuning of the expansion model: {answer['tuning_percent']:.0f} % of the excitation seen")
    if answer["recorder"]["lost"]:
        print(f"recorder: {answer['recorder']['lost']} ticks lost")
    return 1 if faulty else 0


def latency(config: str, as_json: bool = False) -> int:
    """Histograms of lateness and busy time, slips, and the reference loop's lateness of the same run."""
    answer = ask(load_settings(config).socket.path, {"command": "latency"})
    if as_json:
        print(json.dumps(answer))
        return 0
    period = answer["period_us"]
    print(
        f"{answer['ticks']} ticks of {period:g} us, {answer['slips']} slips "
        f"({1000.0 * answer['slips'] / max(answer['ticks'], 1):.2f} in 1000)"
    )
    print(f"{'':24}{'p50':>9}{'p99':>9}{'p99.9':>9}{'largest':>10}   us")
    for name, label in (
        ("lateness", "wake-up lateness"),
        ("busy", "busy time"),
        ("reference", "idle loop's lateness"),
    ):
        h = answer[name]
        if h["count"]:
            print(f"{label:24}{h['p50_us']:9.0f}{h['p99_us']:9.0f}{h['p999_us']:9.0f}{h['largest_us']:10.0f}")
        else:
            print(
                f"{label:24}  none (loop.reference is off)"
                if name == "reference"
                else f"{label:24}  none yet"
            )
    busy = answer["busy"]
    if busy["count"]:
        print(
            f"{'busy share of the tick':24}"
            + "".join(f"{100.0 * busy[k] / period:8.1f}%" for k in ("p50_us", "p99_us", "p999_us"))
        )
    for name in ("lateness", "busy"):
        print(f"\n{name}, us")
        print(_bars(answer[name]["bins_us"]))
    return 0


def _bars(bins: list[list[int]], width: int = 50) -> str:
    """A histogram of whole microseconds in bins that double."""
    edges = [0, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 1 << 30]
    counts = [
        sum(c for us, c in bins if low <= us < high) for low, high in zip(edges, edges[1:], strict=False)
    ]
    top = max(counts, default=0) or 1
    return "\n".join(
        f"{low:6d} .. {high if high < 1 << 30 else '':<5} {count:9d} {'#' * round(width * count / top)}"
        for low, high, count in zip(edges, edges[1:], counts, strict=False)
        if count
    )


def check(config: str) -> int:
    """Validate the configuration, the model, the plant and the profiles; no hardware is touched."""
    from hal.backend import make_backend
    from hal.devices import device_notes
    from thermoctl.daemon.assemble import compensator, law_parameters, power_warning

    settings = load_settings(config)
    law_parameters(settings)
    model = compensator(settings)
    make_backend(settings)
    if warning := power_warning(settings):
        print(f"warning: {warning}")
    print(
        f"{config}: good. back end {settings.hal.backend}, period {settings.loop.period_s * 1e3:g} ms, model "
        f"{settings.compensation.model or 'none'} ({model.kind}, order {len(model.A_minus_I)})"
    )
    if settings.hal.backend == "devices":
        for note in device_notes(settings):
            print(f"note: {note}")
    return 0


def doctor(config: str, seconds: float = 2.0) -> int:
    """Connect, read every channel for `seconds`, show value, unit and rate; drives nothing. 1 when one is bad.

    Then what of the machine decides how late a tick may come, with remedies (docs/how-to/real-time.md); that is advice."""
    from hal.backend import OK, ROLES, STATUS_NAMES, HardwareError, make_backend
    from thermoctl.daemon.arrival import expected_hz, slow
    from thermoctl.daemon.doctor import real_time_checks
    from thermoctl.daemon.loop import become_real_time
    from thermoctl.signals import SIGNALS

    settings = load_settings(config)
    if (pid := holder(settings)) is not None:  # a second master on its buses could disarm it
        raise InputError(f"{config}: pid {pid} holds the rig; look with `thermoctl status`, or stop it first")
    backend = make_backend(settings)
    units = {s.name: s.unit for s in SIGNALS}
    try:
        backend.open()
        counts, looks = dict.fromkeys(ROLES, 0), 0
        expected = expected_hz(settings)
        begin = now = time.monotonic()
        while now < begin + seconds:
            sample = backend.read(now)
            for role, fresh in zip(ROLES, sample.fresh, strict=True):
                counts[role] += int(fresh)
            looks += 1
            backend.write(0.0, False)  # a drive answers to its SYNC; it stays disabled
            time.sleep(settings.loop.period_s)
            now = time.monotonic()
        print(f"{'channel':24}{'value':>14} {'unit':8}{'status':8}{'rate':>10}")
        bad = 0
        for k, role in enumerate(ROLES):
            state = STATUS_NAMES[sample.status[k]]
            if state == "ABSENT" and role not in settings.protection.required:
                continue
            bad += sample.status[k] != OK
            unit = units.get("position_raw_um" if role == "position_um" else role, "")
            said = backend.problem(role) or slow(role, counts[role] / seconds, expected, looks / seconds)
            problem = f"   {said}" if said else ""
            print(
                f"{role:24}{sample.value[k]:14.4f} {unit:8}{state:8}{counts[role] / seconds:7.1f} Hz{problem}"
            )
    except HardwareError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 3
    finally:
        backend.close()
    print("\nreal time:")
    refused: list[str] = []
    become_real_time(settings, refused.append)
    for line in refused or ["priority, locked memory, processor and latency request are all granted"]:
        print(f"  {line}")
    for check in real_time_checks(settings):
        print(
            f"  {check.name:24}{'good' if check.good else 'tune'}  {check.found}"
            + ("" if check.good else f"\n{'':30}-> {check.remedy}")
        )
    return 1 if bad else 0


def service_files(action: str, config: str | None, root: str) -> int:
    """service install | uninstall."""
    from thermoctl.daemon import service as services

    if action == "install":
        return services.install(Path(config or ""), Path(root))
    return services.uninstall(Path(config) if config else None, Path(root))


def demo(config: str, seconds: float | None) -> int:
    """The live view of a daemon of its own."""
    from thermoctl.daemon.view import demo as show

    return show(load_settings(config), seconds)


def run_simulated_time(config: str, hours: float, no_compensation: bool, out: str | None) -> int:
    """Hours of rig time without a clock; see simulate.warm_up_proof."""
    from thermoctl.daemon.simulate import trapezoids

    return trapezoids(load_settings(config), hours, not no_compensation, out)


def replay(recording: str) -> int:
    """Run a recording's inputs through the law; 1 when an output differs in one bit."""
    import numpy as np

    from thermoctl.daemon.replay import replay as run_replay
    from thermoctl.recording.reader import read_rows

    rows, metadata = read_rows(recording)
    begin = time.perf_counter()
    result = run_replay(rows, metadata, recording)
    seconds = time.perf_counter() - begin
    print(
        f"{recording}: {result.ticks} ticks replayed in {seconds:.2f} s"
        + (f", {result.skipped} before the stored state skipped" if result.skipped else "")
    )
    for name, (count, first, largest) in result.differences.items():
        print(f"  {name}: differs in {count} ticks, first in tick {first}, by at most {largest:g}")
    if result.differences:
        return 1
    print(f"  all {np.size(result.outputs)} outputs are the recorded ones, bit for bit")
    return 0
