"""`make wire-rigs`: four rigs from configuration alone, at the wire, each calibrated, compensated and diagnosed.

For each rig `thermoctl virtual-rig` and `thermoctl start` run as two programs on a copy of its shipped configuration. Behind the
wires a plant plays that holds one effect which the believed plant lacks. Then, by commands alone: `calibrate` with shortened
tests, `restart` with its model, one more test, and `diagnose` of the calibration's recordings. The error is the second
encoder's, which the controller does not read: at rest, off in the calibration's last test, on in the same test with the model.

Bodies are lighter than real ones, and the thermometers faster in proportion, so that a calibration takes a quarter of an hour:
the identification wants 200 s of each test.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.devices.emulators import free_port
from thermoctl.recording.files import read_table

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path("build/wire-rigs")
"""Calibrations and diagnoses, in a folder for each rig."""
PROGRAM = [sys.executable, "-m", "thermoctl.cli"]
PAPER_QUICK = 15.0  # how much lighter the paper's bodies are; those of config/examples are ten times lighter
THERMOMETER_HZ = 50
NODES, FLOWS = "\nnodes:\n", "\nflows:\n"
REST_S = 3.0  # at a setpoint, before the error counts
EXPERIMENTS = """\
format: thermoctl-experiments/1
rate_um_s: 100
experiments:
  test_1: {title: Step of power, parts: [{hold: [[2, 0], [10, 240]]}]}
  test_2: {title: Pulses, parts: [{hold: [[60, 240], [40, 0], [50, 240], [60, 0]]}]}
  test_3: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 240, hold_s: [6, 12], duration_s: 150}}, {hold: [[60, 0]]}]}
  test_4a: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 240, hold_s: [10, 8], duration_s: 150}}, {hold: [[60, 0]]}]}
  test_4b: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 240, hold_s: [9], duration_s: 90}}]}
"""


@dataclass(frozen=True)
class Part:
    """An axis, its believed thermal plant, and the effect that its played plant has beside it.

    changes: (old, new) pieces of the played plant's text."""

    thermal: str
    played: str
    effect: str = ""
    changes: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Rig:
    """A shipped configuration, what is calibrated on it by axis, and its model's order."""

    name: str
    config: str
    parts: Mapping[str, Part]
    order: int


RIGS = (
    Rig(
        "the paper's: twelve points, one current amplifier",
        "wire.yaml",
        {
            "": Part(
                "plants/actuator_thermal.yaml",
                "plants/actuator.yaml",
                "sensor_gain at bobbin_c",
                (
                    (
                        "  bobbin_c:           {value: bobbin,",
                        "  bobbin_c: {value: bobbin + 0.2 * (bobbin - air),",
                    ),
                ),
            )
        },
        2,
    ),
    Rig(
        "a stage: two axes, eight points",
        "examples/stage.yaml",
        {
            "x": Part(
                "examples/stage-x.thermal.yaml",
                "examples/stage-x.plant.yaml",
                "missing_link between coil and base",
                (
                    (
                        FLOWS,
                        f"{FLOWS}  hides: {{from: coil, into: base, rate: 0.5 * (coil - base), unit: W}}\n",
                    ),
                ),
            ),
            "y": Part("examples/stage-y.thermal.yaml", "examples/stage-y.plant.yaml"),
        },
        3,
    ),
    Rig(
        "a ball screw: four points, position mode",
        "examples/spindle.yaml",
        {
            "": Part(
                "examples/spindle.thermal.yaml",
                "examples/spindle.plant.yaml",
                "hidden_thermal_mass at motor",
                (
                    (NODES, f"{NODES}  hidden: {{unit: degC, storage: 8, initial: air}}\n"),
                    (
                        FLOWS,
                        f"{FLOWS}  hides: {{from: motor, into: hidden, rate: 0.6 * (motor - hidden), unit: W}}\n",
                    ),
                ),
            )
        },
        3,
    ),
    Rig(
        "small: a DBC amplifier, two thermometers",
        "examples/small.yaml",
        {
            "": Part(
                "examples/small.thermal.yaml",
                "examples/small.plant.yaml",
                "natural_convection at coil",
                (
                    (
                        FLOWS,
                        f"{FLOWS}  hides: {{from: coil, rate: 0.03 * (coil - air) * abs(coil - air)**0.25, unit: W}}\n",
                    ),
                ),
            )
        },
        1,
    ),
)


def lighter(text: str, by: float) -> str:
    """Divide every heat capacity C_NAME and its range."""

    def divided(m: re.Match[str]) -> str:
        return m[1] + re.sub(r"[\d.]+(?:e-?\d+)?", lambda n: f"{float(n[0]) / by:.6g}", m[2]) + m[3]

    text = re.sub(r"^(  C_\w+: *\{value: )([\d.]+)(.*)$", divided, text, flags=re.MULTILINE)
    return re.sub(r"^(  C_\w+: .*range: \[)([^\]]*)(\].*)$", divided, text, flags=re.MULTILINE)


class OnWire:
    """A rig's copy in a folder, with its programs."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig, self.folder = rig, folder
        shutil.copytree(ROOT / "config", folder / "config")
        self.config = folder / "config" / rig.config
        text = self.config.read_text()
        for port in re.findall(r"127\.0\.0\.1:(\d+)", text):
            text = text.replace(port, str(free_port()))
        self.config.write_text(text)
        self.config.with_name("experiments.yaml").write_text(EXPERIMENTS)
        for path in (folder / "config/devices").glob("thermocouples-*.yaml"):
            path.write_text(path.read_text().replace("rate_hz: 10,", f"rate_hz: {THERMOMETER_HZ},"))
        if rig.config == "wire.yaml":
            self._papers()
        for part in rig.parts.values():
            played = folder / "config" / part.played
            text = played.read_text()
            for old, new in part.changes:
                assert text.count(old) == 1, (part, old)
                text = text.replace(old, new)
            played.write_text(text)

    def _papers(self) -> None:
        """The paper's rig without a model, as fast as the others."""
        text = re.sub(r"  model: models/wire.yaml.*", '  model: ""', self.config.read_text())
        text = text.replace("setpoint_rate_um_s: 1 mm/min", "setpoint_rate_um_s: 300")
        text = text.replace(
            "  coil_limit_c: 80\n",
            "  coil_limit_c: 80\n  coil_rate_k_s: 20\n  following_um: 100\n  late_s: 5\n",
        )
        text = text.replace("slew_um_s: 1\n", "slew_um_s: 5\n").replace(
            "  reference: true ", "  reference: false"
        )
        text = text.replace("    - name: drive\n", (
            "    - name: reference\n      profile: devices/encoder-serial.yaml\n      port: ../run/wire/reference\n"
            "      stale_after_s: 0.2\n      roles: {position: output_reference_um}\n    - name: drive\n"))  # fmt: skip
        text = text.replace("period_s: 1 ms", "period_s: 2 ms")
        self.config.write_text(text)
        for name in ("actuator.yaml", "actuator_thermal.yaml"):
            path = self.folder / "config/plants" / name
            path.write_text(lighter(path.read_text(), PAPER_QUICK))

    def command(self, *words: str, axis: str = "", config: bool = True) -> str:
        """Run a command to its end; return what it said."""
        where = [*(["--config", str(self.config)] if config else []), *(["--axis", axis] if axis else [])]
        done = subprocess.run(
            [*PROGRAM, *words, *where],
            cwd=self.folder,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
        )
        with (self.folder / "said.log").open("a") as log:
            log.write(f"$ {' '.join(words)} {axis}\n{done.stdout}{done.stderr}-> {done.returncode}\n")
        assert done.returncode == 0, (words, done.stdout[-800:], done.stderr[-800:])
        return done.stdout

    def on_all(self, *words: str) -> None:
        """Run a command for every axis at the same time; {axis} in a word is its name."""
        with ThreadPoolExecutor() as pool:
            jobs = [
                pool.submit(self.command, *(w.replace("{axis}", a or "rig") for w in words), axis=a)
                for a in self.rig.parts
            ]
            for job in jobs:
                job.result()

    def prove(self) -> list[list[str]]:
        """Calibrate, compensate and diagnose; return the table's rows."""
        with (self.folder / "virtual.log").open("w") as log:
            other_end = subprocess.Popen(
                [*PROGRAM, "virtual-rig", "--config", str(self.config)], stdout=log, stderr=log
            )
        try:
            begun = time.monotonic()
            while "ready" not in (self.folder / "virtual.log").read_text():
                assert other_end.poll() is None and time.monotonic() < begun + 60, (
                    "the virtual rig did not start"
                )
                time.sleep(0.1)  # how often we look
            self.command("start")
            calibrate = ["calibrate", "--yes", "--order", str(self.rig.order), "--out", "calibration/{axis}"]
            self.on_all(*calibrate)
            for axis in self.rig.parts:  # one after the other: both write the same file
                self.command(*(w.replace("{axis}", axis or "rig") for w in calibrate), "--accept", axis=axis)
            minutes = (time.monotonic() - begun) / 60
            self.command("restart")
            self.on_all("experiment", "test_4b", "--yes", "--out", "{axis}-on.parquet")
        finally:
            subprocess.run([*PROGRAM, "stop", "--config", str(self.config)], capture_output=True)
            other_end.terminate()
            other_end.wait(20)
        return [self._row(axis, part, minutes) for axis, part in self.rig.parts.items()]

    def _row(self, axis: str, part: Part, minutes: float) -> list[str]:
        tests = self.folder / "calibration" / (axis or "rig")
        off, on = error_um(tests / "test_4b.parquet"), error_um(self.folder / f"{axis or 'rig'}-on.parquet")
        begun, out = time.monotonic(), self.folder / f"diagnosis-{axis or 'rig'}"
        self.command(
            "diagnose", "--quiet", "--plant", str(self.folder / "config" / part.thermal), "--out", str(out),
            *(str(tests / f"{t}.parquet") for t in ("test_2", "test_3", "test_4a")), config=False,
        )  # fmt: skip
        result = json.loads((out / "diagnosis.json").read_text())
        found = "; ".join(
            f"{f['effect']} at {f['where']} ({f['probability']:.2f})" for f in result["findings"]
        )
        return [
            f"{self.rig.name}{f', axis {axis}' if axis else ''}", f"{minutes:.0f}", f"{off:.2f}", f"{on:.2f}",
            part.effect or "nothing", found or "nothing", result["verdict"], f"{time.monotonic() - begun:.0f}",
        ]  # fmt: skip


def error_um(path: Path) -> float:
    """Return the output's largest error at rest, um, less the encoders' difference at the start."""
    t = read_table(path)
    c = t.columns
    origin = np.nanmean((c["output_reference_um"] - c["position_raw_um"])[:5])
    error = c["output_reference_um"] - c["reference_um"] - origin
    moving = np.abs(c["reference_um"] - c["setpoint_um"]) > 1e-6
    since = t.t - np.maximum.accumulate(np.where(moving, t.t, -np.inf))
    return float(np.nanmax(np.abs(error[(since > REST_S) & ~moving])))


TITLE = (
    "rig", "calibration, min", "error off, um", "error on, um", "hidden", "diagnosed (probability)", "verdict", "s"
)  # fmt: skip


def main(names: Sequence[str]) -> int:
    """Print the table of the rigs whose configuration is named, of all by default."""
    print("| " + " | ".join(TITLE) + " |\n|" + " --- |" * len(TITLE), flush=True)
    failed = 0
    for rig in RIGS:
        if names and Path(rig.config).stem not in names:
            continue
        folder = Path(tempfile.mkdtemp(prefix="wire-rig-"))
        try:
            for row in OnWire(rig, folder).prove():
                print("| " + " | ".join(row) + " |", flush=True)
            kept = KEPT / Path(rig.config).stem
            for part in (*folder.glob("diagnosis-*"), *folder.glob("calibration")):
                shutil.copytree(part, kept / part.name, dirs_exist_ok=True)
            shutil.rmtree(folder)
        except (AssertionError, subprocess.SubprocessError) as e:
            failed = 1
            print(f"| {rig.name} | failed: {e}; its files: {folder} |", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
