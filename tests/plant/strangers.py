"""Four strangers: a rig of another simulator, the file that its tool writes, and the way to the right name.

Each rig is integrated here by its own equations; one of its laws is hidden from the plant that is made from the
file. `python -m tests.plant.strangers` prints commands, edits and processor times; `make strangers` calls it.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from thermoctl import cli

SIGMA = 5.67e-8  # Stefan and Boltzmann, W/m^2/K^4
BEGIN = datetime(2026, 3, 14, 9, 26, 53, tzinfo=UTC)


@dataclass(frozen=True)
class Stranger:
    """A rig: the writer of its file, the options of `plant new`, edits (from, to), and the hidden law's name."""

    name: str
    file: str
    write: Callable[[Path], None]
    new: str
    edits: tuple[tuple[str, str], ...]
    hidden: tuple[str, str]


def steps(rng: np.random.Generator, t: np.ndarray, every: float, levels: tuple[float, ...]) -> np.ndarray:
    """Return a course that takes one of some levels, anew after about `every` seconds (N,)."""
    out, now = np.zeros(len(t)), 0.0
    while now < t[-1]:
        out[t >= now] = rng.choice(levels)
        now += every * rng.uniform(0.6, 1.4)
    return out


def motor(path: Path) -> None:
    """A servo motor's winding and housing; hidden: the copper's resistance rises with its temperature."""
    rng = np.random.default_rng(11)
    dt, t = 0.25, np.arange(0.0, 7200.0, 0.25)
    current = steps(rng, t, 600.0, (0.0, 3.0, 6.0, 8.0, 10.0))
    winding, housing, air = 23.1, 22.8, 22.4 + 0.4 * np.sin(t / 2900)
    rows = []
    for k, now in enumerate(t):
        if k % 8 == 0:  # every 2 s
            seen = (current[k] + rng.normal(0, 0.002), winding, housing, air[k])
            noisy = [seen[0], *(s + rng.normal(0, 0.08) for s in seen[1:])]
            stamp = (BEGIN + timedelta(seconds=float(now))).strftime("%d.%m.%Y;%H:%M:%S")
            rows.append(
                [stamp, *(f"{x:.{3 if j == 0 else 2}f}".replace(".", ",") for j, x in enumerate(noisy))]
            )
        heat = 0.42 * (1 + 0.00393 * (winding - 20)) * current[k] ** 2
        through = 1.4 * (winding - housing)
        winding += dt * (heat - through) / 48
        housing += dt * (through - 0.62 * (housing - air[k])) / 330
    head = "Messung Servomotor Achse 3\nBearbeiter: K. Müller\n\nDatum;Uhrzeit;Motorstrom;Wicklung;Gehäuse;Raumluft\n;;[A];[°C];[°C];[°C]\n"
    path.write_text(head + "".join(";".join(r) + "\n" for r in rows), encoding="latin-1", newline="\r\n")


def building(path: Path) -> None:
    """A house of which Home Assistant keeps each change of state; hidden: its walls store heat."""
    rng = np.random.default_rng(12)
    dt, t = 10.0, np.arange(0.0, 9 * 86400.0, 10.0)
    outside = 3 + 4 * np.sin(2 * np.pi * (t / 86400 - 0.3)) + 2 * np.sin(2 * np.pi * t / 400_000)
    power = steps(rng, t, 14_000.0, (0.0, 600.0, 1200.0, 2000.0))
    room, walls = 19.0, 17.5
    events: list[tuple[float, str, str]] = []
    last: dict[str, str] = {}

    def say(now: float, entity: str, state: str) -> None:
        """Note a state where it differs from the last one."""
        if last.get(entity) != state:
            last[entity] = state
            events.append((now + rng.uniform(0.1, 0.9), entity, state))

    for k, now in enumerate(t):
        if k % 6 == 0:  # the thermometers report every minute
            say(now, "sensor.living_room_temperature", f"{room + rng.normal(0, 0.04):.1f}")
        if k % 30 == 0:
            say(now, "sensor.outdoor_temperature", f"{outside[k] + rng.normal(0, 0.05):.1f}")
        say(now, "sensor.heat_pump_power", f"{power[k]:.0f}")
        if k == 20_000:
            say(now, "sensor.living_room_temperature", "unavailable")
        say(now, "binary_sensor.front_door", "on" if 25_000 < k % 40_000 < 25_010 else "off")
        through = 160.0 * (room - walls)
        room += dt * (power[k] - through - 55.0 * (room - outside[k])) / 1.6e6
        walls += dt * through / 9e6
    events.sort()
    with open(path, "w", encoding="utf-8", newline="") as f:
        out = csv.writer(f)
        out.writerow(["entity_id", "state", "last_changed"])
        for entity in sorted(last):
            for now, who, state in events:
                if who == entity:
                    out.writerow(
                        [who, state, f"{BEGIN + timedelta(seconds=now):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z"]
                    )


def printer(path: Path) -> None:
    """A printer's hot end and bed under PID control; hidden: the hot block radiates."""
    rng = np.random.default_rng(13)
    dt, t = 0.1, np.arange(0.0, 3600.0, 0.1)
    targets = {
        "extruder": steps(rng, t, 420.0, (0.0, 120.0, 180.0, 230.0, 270.0)),
        "heater_bed": steps(rng, t, 1500.0, (0.0, 60.0)),
    }
    block, bed, air, sums = 23.0, 23.4, 23.0, {"extruder": 0.0, "heater_bed": 0.0}
    lines = ["Starting Klippy...", "Args: ['/home/pi/klipper/klippy/klippy.py', '/home/pi/printer_data/config/printer.cfg']",
             "===== Config file =====", "[extruder]", "max_temp = 290", "=======================", "Loaded MCU 'mcu' 112 commands"]  # fmt: skip
    pwm = {"extruder": 0.0, "heater_bed": 0.0}
    for k, now in enumerate(t):
        for name, temp, gain in (("extruder", block, 0.05), ("heater_bed", bed, 0.15)):
            if k % 3 == 0:
                error = targets[name][k] - temp
                sums[name] = min(max(sums[name] + 0.0015 * error * 0.3, 0.0), 1.0)
                pwm[name] = (
                    round(min(max(gain * error + sums[name], 0.0), 1.0), 3) if targets[name][k] else 0.0
                )
        if k % 10 == 0:
            heaters = " ".join(
                f"{n}: target={targets[n][k]:.0f} temp={x + rng.normal(0, 0.12):.1f} pwm={pwm[n]:.3f}"
                for n, x in (("heater_bed", bed), ("extruder", block))
            )
            lines.append(
                f"Stats {5123.4 + now:.1f}: gcodein=0  mcu: mcu_awake=0.014 mcu_task_avg=0.000013 bytes_write={4000 + 9 * k} "
                f"bytes_read={9000 + 7 * k} freq=179998{k % 97:03d} {heaters} sysload={0.4 + rng.uniform(0, 0.2):.2f} "
                f"cputime={12 + now / 90:.3f} memavail=3455{k % 100:02d} print_time={now:.3f} buffer_time=0.000 print_stall=0"
            )
            if k % 4000 == 0:
                lines.append("Exiting SD card print" if k else "webhooks client 1994472176: New connection")
        radiated = 0.9 * SIGMA * 2.6e-3 * ((block + 273.15) ** 4 - (air + 273.15) ** 4)
        block += dt * (50 * pwm["extruder"] - 0.06 * (block - air) - radiated) / 17
        bed += dt * (220 * pwm["heater_bed"] - 1.7 * (bed - air)) / 610
    path.write_text("\n".join(lines) + "\n")


def axis(path: Path) -> None:
    """A linear motor's axis on an oscilloscope; hidden: dry friction."""
    rng = np.random.default_rng(14)
    n, dt = 100_000, 1e-4
    t = np.arange(-n // 5, n) * dt - 1.0
    current = 2.2 * np.sin(2 * np.pi * 0.9 * t) + 1.6 * np.sin(2 * np.pi * 2.3 * t + 0.4)
    x, v, place = 0.0, 0.0, np.zeros(len(t))
    for k in range(len(t)):
        place[k] = x
        force = 14.0 * current[k] - 22.0 * v - 9.0 * np.tanh(v / 1e-3)
        v += dt * force / 3.2
        x += dt * v

    t, current, place = t[-n:], current[-n:], place[-n:]  # it is in motion when the recording begins

    def digits(values: np.ndarray, step: float, noise: float) -> np.ndarray:
        """Return values as a converter of 12 bits shows them."""
        return np.round((values + rng.normal(0, noise, n)) / step) * step

    amperes, millimetres = digits(current, 4e-3, 5e-3), digits(1e3 * place, 0.05, 0.05)
    head = (
        "Model,MSO54\nLabel,,\nWaveform Type,ANALOG,ANALOG\nPoint Format,Y,Y\nHorizontal Units,s,\nHorizontal Scale,1,\n"
        f"Horizontal Delay,0,\nSample Interval,{dt},\nRecord Length,{n},\nGating,0.0% to 100.0%,\nProbe Attenuation,1,1\n"
        "Vertical Units,A,mm\nVertical Offset,0,0\nVertical Scale,1,20\nVertical Position,0,0\n,,\n,,\nLabel,,\nTIME,CH1,CH2\n"
    )
    body = io.StringIO()
    np.savetxt(body, np.column_stack([t, amperes, millimetres]), fmt=["%.7e", "%.4f", "%.3f"], delimiter=",")
    path.write_text(head + body.getvalue())


STRANGERS = (
    Stranger("motor", "motor.csv", motor, "--template motor", (("R: {value: 0.5,", "R: {value: 0.42,"),),
             ("copper_resistance", "copper_loss")),
    Stranger("building", "history.csv", building, "", (), ("hidden_thermal_mass", "living_room")),
    Stranger("printer", "klippy.log", printer, "", (('P_full_extruder_pwm: {value: "?"', "P_full_extruder_pwm: {value: 50"),
             ('P_full_heater_bed_pwm: {value: "?"', "P_full_heater_bed_pwm: {value: 220")), ("radiation", "extruder")),
    Stranger("axis", "scope.csv", axis, "", (('value: "?"', "value: 14"),), ("coulomb_friction", "speed")),
)  # fmt: skip


def run(stranger: Stranger, folder: Path) -> tuple[list[str], list[tuple[str, str]]]:
    """Write a stranger's file, go the way to a diagnosis in `folder`, and return its log and the names found.

    Raises AssertionError for a command that fails or an edit whose place is not there."""
    lines = []
    stranger.write(folder / stranger.file)
    size = (folder / stranger.file).stat().st_size / 1e6
    lines.append(
        f"{stranger.name}: {stranger.file}, {size:.1f} MB; hidden: {stranger.hidden[0]} at {stranger.hidden[1]}"
    )

    def command(line: str) -> None:
        """Run a command in the folder."""
        out, err, begin = io.StringIO(), io.StringIO(), time.process_time()
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main(line.split())
        lines.append(f"{time.process_time() - begin:7.1f} s  thermoctl {line}")
        if os.environ.get("THERMOCTL_SHOW"):
            lines.append(out.getvalue() + err.getvalue())
        assert status == 0, f"{line}: {out.getvalue()}{err.getvalue()}"

    command(f"plant new {stranger.name}.yaml --from-csv {stranger.file} {stranger.new}".strip())
    plant = folder / f"{stranger.name}.yaml"
    for old, new in stranger.edits:
        text = plant.read_text()
        assert text.count(old) == 1, f"'{old}' stands {text.count(old)} times in {text}"
        plant.write_text(text.replace(old, new))
        lines.append(f"     edit  {new}")
    command(f"plant check {plant.name} --data {stranger.file}")
    command(f"diagnose --plant {plant.name} {stranger.file} --out {stranger.name} --quiet")
    result = json.loads((folder / stranger.name / "diagnosis.json").read_text())
    named = [(f["effect"], f["where"]) for f in result["findings"]]
    lines.append(f"   {result['verdict']}: {', '.join(f'{e} at {w}' for e, w in named)}")
    return lines, named


if __name__ == "__main__":
    for stranger in STRANGERS:
        if sys.argv[1:] and stranger.name not in sys.argv[1:]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            print(*run(stranger, Path(folder))[0], sep="\n", flush=True)
