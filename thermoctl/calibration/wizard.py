"""The calibration wizard: doctor, step, PID, tests 1 to 4A, model, proof, and on request acceptance.

Each step writes its result into the calibration's own folder (`--out`). The command can be ended at any time;
a new call continues with the first step that is not done. Nothing outside that folder is written before
`--accept`.

With a running daemon the tests run on it in real time: setpoints through the socket, rows from its shared
memory. An interrupted test continues from there. The daemon's own recording fills the rows between, because
the rig cools meanwhile; if that recording has a gap, the test starts again.

Without a daemon a simulated rig runs faster than real time. The same seed gives the same rows, so an
interrupted test is simply run again.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from thermoctl.calibration import drive, steps
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import as_table, kept, recover, stream_of
from thermoctl.calibration.report import report
from thermoctl.calibration.schedules import of_config, span
from thermoctl.calibration.simulated_rig import SimulatedRig
from thermoctl.configuration.settings import Settings, effective
from thermoctl.files.kept import reading
from thermoctl.files.safe_file import make_folder, move, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modelfile, tuning
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.recording.files import write_table
from thermoctl.rig.signals import AT

TESTS = ("test_1", "test_2", "test_3", "test_4a", "test_4b")
RESULTS: dict[str, type[steps.Result]] = {
    "doctor": steps.Doctor,
    "step": steps.Response,
    "pid": steps.Pid,
    "test_1": steps.Test,
    "test_2": steps.Test,
    "test_3": steps.Test,
    "test_4a": steps.Test,
    "model": steps.Model,
    "test_4b": steps.Test,
    "proof": steps.Proof,
}
STEPS = tuple(RESULTS)
EVERY_PERCENT = 10.0  # progress of a test between two lines, without a terminal

_R = TypeVar("_R", bound=steps.Result)


class Wizard:
    """One calibration in its folder: `done` {step: result}.

    `run(keyboard)` does the steps that are not done."""

    def __init__(
        self,
        settings: Settings,
        rig: drive.DrivenRig,
        folder: Path,
        tests: Mapping[str, Schedule],
        order: int,
        say: Callable[[str], None],
    ):
        self.settings, self.rig, self.folder = settings, rig, folder
        self.order, self.say = order, say
        self.state_path = folder / "state.json"
        self.experiments = of_config(settings.path)
        self.fingerprint = self._fingerprint()
        self.done: dict[str, steps.Result] = {}
        self.at_s: dict[str, float] = {}  # time reached by an interrupted test
        # Wall and rig seconds of tests in this run, for the time left.
        self._used_s, self._tested_s = 0.0, 0.0
        for name in TESTS:
            if name not in tests:
                raise InputError(f"{self.experiments}: no experiment '{name}'; a calibration needs it")
        self.tests = {name: tests[name] for name in TESTS}
        if self.state_path.exists():
            self._load()

    def _load(self) -> None:
        with reading(
            self.state_path, "a calibration's state", "give another --out, or start again with --again"
        ):
            state = json.loads(self.state_path.read_bytes())
            if state.pop("checksum") != _checksum(state):
                raise ValueError("its checksum does not fit")
            self.done = {k: RESULTS[k](**v) for k, v in state["done"].items()}
            self.at_s, configuration = state["at_s"], state["configuration"]
        if configuration != self.fingerprint:
            raise InputError(
                f"{self.folder}: was started with another configuration or other experiments than {self.settings.path} has now; "
                "put them back, or start again with --again"
            )

    def _fingerprint(self) -> str:
        files = effective(self.settings).encode() + self.experiments.read_bytes()
        return hashlib.sha256(files).hexdigest()

    def _save(self) -> None:
        make_folder(self.folder)
        done = {k: asdict(v) for k, v in self.done.items()}
        state = {"configuration": self.fingerprint, "done": done, "at_s": self.at_s}
        state["checksum"] = _checksum(state)
        write_text(self.state_path, json.dumps(state, indent=1))

    def result(self, step: str, kind: type[_R]) -> _R:
        """Return the result of a step that is done."""
        result = self.done[step]
        assert isinstance(result, kind)
        return result

    def run(self, keyboard: Keyboard) -> bool:
        """Do every step that is not done; False when it was ended early.

        Raises InputError where a step refuses."""
        self.say(
            f"calibration of rig '{self.settings.rig.name}' on {self.rig.where}; results in {self.folder}/"
        )
        self._save()
        for number, step in enumerate(STEPS, 1):
            if step in self.done:
                self.say(f"{number:2d}/{len(STEPS)} {step}: done before")
                continue
            if keyboard.ended:
                return False
            if step in self.tests:
                with keyboard.listening():
                    if not self._test(number, step, keyboard):
                        return False
            else:
                self.done[step] = self._step(step)
                self.say(f"{number:2d}/{len(STEPS)} {step}: {self.done[step].summary}")
            self._save()
        self._report()
        return True

    def _step(self, step: str) -> steps.Result:
        recordings = {name: self._recording(name) for name in TESTS}
        match step:
            case "doctor":
                return steps.doctor(self.rig.now()["channels"], self.settings)
            case "step":
                return steps.response(self.settings, self.rig)
            case "pid":
                return steps.pid(self.rig)
            case "model":
                return steps.model(self.settings, recordings, self.order, self._model_path)
        return steps.proof(self.settings, recordings, self.order, acting=not self.rig.real)

    def _test(self, number: int, name: str, keyboard: Keyboard) -> bool:
        """Run a test to its end; return False if it was interrupted: a new call continues from there."""
        schedule, part = self.tests[name], self.folder / f"{name}.part.parquet"
        earlier, at_s = None, 0.0
        recover(part)
        if name in self.at_s:
            earlier, at_s = drive.earlier_part(
                self.rig, part, self.at_s[name], lambda line: self.say(f"   {name} {line}")
            )
        self.say(f"{number:2d}/{len(STEPS)} {name}: {schedule.title}, {span(schedule.duration_s)}")
        left_s = sum(
            self.tests[n].duration_s for n in STEPS[number:] if n in self.tests and n not in self.done
        )
        progress_line = _progress_line(lambda p: self._time_left(p, left_s))
        done_s = [at_s]

        def show(p: Progress) -> None:
            """Keep the time reached, s, and show it."""
            done_s[0] = p.done_s
            progress_line(p)

        def note() -> None:
            """Save the time reached, for the next call."""
            self.at_s[name] = done_s[0]
            self._save()

        acting = name == "test_4b" and isinstance(self.rig, SimulatedRig)
        model = modelfile.load_model(self._model_path) if acting else None
        blocks, ended, started = [], None, time.monotonic()
        try:
            run = self.rig.run(schedule, show, keyboard, earlier, at_s, model)
            for block in kept(run, part, self.settings.row, note):
                blocks.append(block)
        except Aborted as e:
            ended = e
        self._used_s += time.monotonic() - started
        self._tested_s += ended.done_s if ended else schedule.duration_s - at_s
        print(file=sys.stderr)
        if blocks:
            write_table(part, as_table(np.vstack(blocks), part, self.settings.row))
        stream_of(part).unlink(missing_ok=True)
        if ended is not None:
            self.at_s[name] = ended.done_s
            self._save()
            self.say(
                f"{name} ended at {ended.done_s:.0f} s: {ended.reason}. What was recorded is in {part}; "
                "the same command goes on from here"
            )
            return False
        move(part, self._recording(name))
        self.at_s.pop(name, None)
        power = np.vstack(blocks)[:, AT["power_w"]]
        self.done[name] = steps.Test(
            f"{span(schedule.duration_s)} recorded",
            schedule.duration_s,
            float(np.nanmean(power)),
            float(np.nanmax(power)),
        )
        return True

    def _time_left(self, p: Progress, left_s: float) -> tuple[float, float]:
        """Estimate the seconds left of this test and of all, at the pace of the tests so far."""
        pace = (self._used_s + p.used_s) / max(self._tested_s + p.done_s, 1e-9)
        return pace * (p.duration_s - p.done_s), pace * (p.duration_s - p.done_s + left_s)

    def _recording(self, name: str) -> Path:
        return self.folder / f"{name}.parquet"

    @property
    def _model_path(self) -> Path:
        return self.folder / "model.yaml"

    def _report(self) -> None:
        path = self.folder / "report.html"
        write_text(
            path,
            report(
                self.settings.rig.name,
                self.rig.where,
                {k: v.summary for k, v in self.done.items()},
                self.result("step", steps.Response),
                self.result("pid", steps.Pid),
                self.result("model", steps.Model),
                self.result("proof", steps.Proof),
            ),
        )
        self.say(f"before and after: {path}")

    def changes(self, models: Path, gains: bool) -> list[str]:
        """List the changes of an acceptance, as lines."""
        lines = [f"install {self._model_path} as the current calibration of {models}/"]
        if gains:
            present, proven = self.result("pid", steps.Pid).gains()
            difference = f"write into {self.settings.path}:\n{tuning.difference(present, proven)}"
            lines.append(difference if proven != present else f"keep the gains ({self.done['pid'].summary})")
        if not self._in_use(models):
            now = self.settings.compensation.model or "not set"
            lines.append(
                f"set compensation.model in {self.settings.path} to {self._model_option(models)} (now {now})"
            )
        return lines

    def _in_use(self, models: Path) -> bool:
        return Path(self.settings.compensation.model or ".").resolve() == models.resolve()

    def _model_option(self, models: Path) -> str:
        """Return the folder of calibrations relative to the configuration, as the configuration names it."""
        return os.path.relpath(models.resolve(), Path(self.settings.path).resolve().parent)

    def accept(self, models: Path, gains: bool) -> None:
        """Install the model, name it in the configuration, and write the gains when asked.

        Raises InputError when the proof shows no improvement."""
        proof = self.result("proof", steps.Proof)
        if not proof.better:
            raise InputError(
                f"{self.folder}: the proof shows no smaller error with the new model than without; nothing was installed"
            )
        c = modelfile.load_calibration(self._model_path, self.settings.rig.name)
        figures: dict[str, Any] = {
            **c.figures,
            "proof_before_um": list(proof.before),
            "proof_after_um": list(proof.after),
        }
        recordings = [self._recording(n) for n in steps.FITTED]
        path = modelfile.install(models, c.model, c.rig, recordings, figures)
        present, proven = self.result("pid", steps.Pid).gains()
        if gains and proven != present:
            tuning.write(Path(self.settings.path), proven, self.settings.axis)
        if not self._in_use(models):
            try:
                values = {"model": f"{self._model_option(models)}  # written by `thermoctl calibrate`"}
                tuning.write_values(Path(self.settings.path), "compensation", values, self.settings.axis)
            except InputError as e:  # the model is installed; the user has to enter its name
                self.say(str(e))
        self.fingerprint = self._fingerprint()
        self._save()
        self.say(
            f"{path} is current; older ones stay (`thermoctl model rollback`). `thermoctl restart` uses it."
        )


def _checksum(state: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(state, sort_keys=True).encode()).hexdigest()


def _progress_line(time_left: Callable[[Progress], tuple[float, float]]) -> Callable[[Progress], None]:
    """Show progress: a line that is overwritten on a terminal, else a new line every EVERY_PERCENT."""
    shown = [-1.0]

    def show(p: Progress) -> None:
        """Print the progress of a test, and the time left of it and of all tests."""
        here, everything = time_left(p)
        line = f"   {p.percent:5.1f} %   {span(here)} left of this test, {span(everything)} of all"
        if sys.stderr.isatty():
            print(f"\r{line:78}", end="", file=sys.stderr, flush=True)
        elif p.percent - shown[0] >= EVERY_PERCENT:
            shown[0] = p.percent
            print(line, file=sys.stderr, flush=True)

    return show
