"""Does anything grow? Memory and open descriptors over hours of simulated and minutes of real time.

    python tests/bench/realtime/steady.py [--hours 6] [--minutes 5] [--wire-ticks 1000000] [--out FILE]

simulated   the loop's tick, the recorder with its files and their budget, the supervisor's look at the ring and its keeping of
            the estimates, and the command socket's answers, in one process, in simulated time
drivers     serial and CAN drivers read and written without a pause, against the bench's peer
daemon      the whole daemon with its processes in real time, asked for its status 50 times a second, moved, and reloaded
            every ten seconds (each a new recording)

Compared are the medians of the middle and the last third: a process that has settled must not grow by over 1 %, and its
fewest descriptors (a client comes and goes) must stay the same. Ends with 1 where one does not. `make bench-realtime` runs it after run.py.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.realtime.run import ROOT, Bench, machine
from tests.simulated import rig_file

Sample = tuple[float, int, int]  # time (h, share or s), resident kB, descriptors
GROWTH = 0.01


def look(pid: int | str = "self") -> tuple[int, int]:
    """(resident kB, open descriptors) of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]), len(os.listdir(f"/proc/{pid}/fd"))


def configuration(work: Path) -> Path:
    """The simulated rig, recording into `work` within a budget that hours of it exceed many times."""
    budgets = ("budget_gb: 2", "budget_gb: 0.05"), ("tier_budget_gb: 0.5", "tier_budget_gb: 0.01")
    return rig_file(work, *budgets)


def simulated(work: Path, hours: float) -> list[Sample]:
    """A sample every five minutes of simulated time."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl.daemon import keep
    from thermoctl.daemon.command_server import Commands
    from thermoctl.daemon.journal import Watcher
    from thermoctl.daemon.offline.simulate import Simulation
    from thermoctl.daemon.recorder import make_recorder
    from thermoctl.daemon.tick.shared import Shared

    def silent(*_: Any, **__: Any) -> None:
        pass

    settings = load_settings(configuration(work))
    shared = Shared.create(f"thermoctl-steady-{os.getpid()}")
    try:
        simulation = Simulation(settings, publish=shared.ring)
        recorder, watcher = make_recorder(settings, shared, silent), Watcher(shared, silent)
        commands = Commands(shared, settings, silent, silent)
        simulation.arm()
        found = []
        for five_minutes in range(round(12 * hours)):
            for part in range(60):
                simulation.command("setpoint", 50.0 * (part % 3))
                if part % 20 == 10:  # a fault that trips, acknowledged and armed again
                    simulation.command("disarm")
                    simulation.tick(300)
                    simulation.command("arm")
                simulation.tick(5000)
                recorder.move()
                watcher.look()
                commands.answer(b'{"command": "status"}', "uid 0 pid 0")
                keep.save(keep.kept_path(settings), simulation.law.model, simulation.law.snapshot())
            found.append(((five_minutes + 1) / 12, *look()))
        recorder.close()
        simulation.close()
        assert simulation.ticks > hours * 3.6e6
    finally:
        shared.remove()
    return found


def drivers(bench: Bench, ticks: int) -> list[Sample]:
    """A sample every twentieth of the ticks."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl_hal.rig.make import make_backend

    backend = make_backend(load_settings(bench.config))
    backend.open()
    found = []
    try:
        for part in range(20):
            for _ in range(ticks // 20):
                backend.read(time.monotonic())
                backend.write(0.0, False)
            found.append(((part + 1) / 20, *look()))
    finally:
        backend.close()
    return found


def daemon(work: Path, minutes: float) -> dict[str, list[Sample]]:
    """A sample of each process every two seconds, from the tenth second on."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl.daemon.control_socket import ask
    from thermoctl.files.yamlfile import InputError

    config = configuration(work)
    settings = load_settings(config)
    with (work / "daemon.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", "run", "--config", str(config)], stderr=log, cwd=ROOT
        )
    found: dict[str, list[Sample]] = {}

    def asked(**request: Any) -> dict[str, Any]:
        with contextlib.suppress(InputError):
            return ask(settings.socket.path, request)
        return {}

    try:
        begin = time.monotonic()
        while asked(command="status").get("state") != "READY":
            if process.poll() is not None or time.monotonic() - begin > 60.0:
                raise SystemExit("the daemon did not start:\n" + (work / "daemon.log").read_text())
            time.sleep(0.05)
        children = sorted(
            int(p) for p in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        )
        names = dict(zip(("loop", "recorder", "commands", "idle loop"), children, strict=True)) | {
            "supervisor": process.pid
        }
        asked(command="arm")
        begin, rounds, reloads = time.monotonic(), 0, 0
        while (now := time.monotonic() - begin) < minutes * 60.0:
            asked(command="status")
            if rounds % 50 == 0:
                asked(command="setpoint", value=float(20 * (rounds // 50 % 3)))
            if rounds % 500 == 0:
                text = config.read_text()
                config.write_text(
                    text.replace("kp: 0.01\n", "kp: 0.0101\n")
                    if "kp: 0.01\n" in text
                    else text.replace("kp: 0.0101\n", "kp: 0.01\n")
                )
                reloads += bool(
                    asked(command="reload").get("ok")
                )  # a machine that is busy may not answer in time
            if rounds % 100 == 0 and now > 10.0:
                for name, pid in names.items():
                    found.setdefault(name, []).append((now, *look(pid)))
            rounds += 1
            time.sleep(0.02)
        assert reloads, f"none of {rounds // 500} reloads was answered"
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)
    return found


def in_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function` in a fresh process, so that its memory is its own."""
    fork = multiprocessing.get_context("fork")
    queue: Any = fork.SimpleQueue()
    child = fork.Process(target=lambda: queue.put(function(*arguments)))
    child.start()
    child.join()
    if child.exitcode:
        raise SystemExit(f"{function.__name__} failed")
    return queue.get()


def table(found: dict[str, tuple[str, list[Sample]]]) -> Iterator[tuple[str, bool]]:
    """Lines of the table, and whether each is kept; found: what -> (over what, samples)."""
    for what, (over, samples) in found.items():
        t, kb, fds = (np.array(c) for c in zip(*samples, strict=True))
        third = len(t) // 3
        before, after = (float(np.median(kb[s])) for s in (slice(third, -third), slice(-third, None)))
        slope = float(np.polyfit(t[third:], kb[third:], 1)[0])
        kept = after - before <= GROWTH * before and fds[third:-third].min() == fds[-third:].min()
        yield (
            f"| {what} | {over} | {kb[third]} to {kb[-1]} kB | {after - before:+.0f} kB | {slope:+.1f} kB/"
            f"{'h' if 'h ' in over else 'min' if 'min' in over else 'run'} | {fds[third:].min()} to {fds[third:].max()} | "
            f"{'yes' if kept else '**no**'} |",
            kept,
        )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=6.0, help="of simulated time")
    parser.add_argument("--minutes", type=float, default=5.0, help="of the real daemon")
    parser.add_argument("--wire-ticks", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, help="also write the table here (Markdown)")
    parser.add_argument("--raw", type=Path, help="also write every sample here (JSON)")
    args = parser.parse_args()
    found: dict[str, tuple[str, list[Sample]]] = {}
    with tempfile.TemporaryDirectory(prefix="thermoctl-steady-") as folder:
        work = Path(folder)
        if args.wire_ticks:
            bench = Bench(work, 1)
            bench.start_peer()
            try:
                found["serial and CAN drivers"] = (
                    f"{args.wire_ticks:,} ticks",
                    in_child(drivers, bench, args.wire_ticks),
                )
            finally:
                bench.stop_peer()
        for name, samples in (daemon(work, args.minutes) if args.minutes else {}).items():
            found[f"daemon: {name}"] = f"{args.minutes:g} min", [(t / 60.0, *more) for t, *more in samples]  # type: ignore[misc]
        if args.hours:
            found["loop, recorder, supervisor, commands"] = (
                f"{args.hours:g} h of simulated time",
                in_child(simulated, work, args.hours),
            )
    lines = list(table(found))
    text = "\n".join(
        [
            *machine(),
            "",
            "| what | over | resident | last third over middle third | slope | descriptors | steady |",
            "|---|---|---|---|---|---|---|",
            *(line for line, _ in lines),
            "",
        ]
    )
    print(text)
    if args.out:
        args.out.write_text(text)
    if args.raw:
        args.raw.write_text(json.dumps(found))
    return 0 if all(kept for _, kept in lines) else 1


if __name__ == "__main__":
    sys.exit(main())
