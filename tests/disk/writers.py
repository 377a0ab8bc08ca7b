"""Every writer of the product, as the sweep runs it: mostly whole commands in an empty folder."""

from __future__ import annotations

import dataclasses
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.disk.harness import Writer, tell
from thermoctl import cli
from thermoctl.api import diagnosing
from thermoctl.calibration import steps, wizard
from thermoctl.configuration.settings import effective, load_settings
from thermoctl.control.model import zero_model
from thermoctl.daemon import keep, service
from thermoctl.daemon.views import demo
from thermoctl.devices import new as devices_new
from thermoctl.diagnosis import run as diagnosis
from thermoctl.diagnosis.law.result import save_effect
from thermoctl.files import shipped
from thermoctl.identify import modelfile, tuning
from thermoctl.plant import load
from thermoctl.recording.files import read_table
from thermoctl.recording.reader import info
from thermoctl.recording.writer import FULL, TIER, RecordingWriter, recording_files
from thermoctl.rig.signals import SIGNALS

ROOT = Path(__file__).resolve().parents[2]
HEATER = ROOT / "docs/examples/heater"
PLANT, LOG = str(HEATER / "plant.yaml"), str(HEATER / "run_1.csv")
SIMULATED = ROOT / "config/simulated.yaml"
MODEL = dataclasses.replace(zero_model(), kind="kalman")
NAMES = ("t_s", "wall_s", "tick", "state", "fault_bits", "drive", "position_um")
FEW = tuple(s for s in SIGNALS if s.name in NAMES)  # the writer does not know how many there are
AT = {s.name: k for k, s in enumerate(FEW)}
RATE = 20  # ticks a second: fewer rows, as many batches


# ------------------------------------------------------------------------------------------------ the recorder
def _rows(begin: int, count: int) -> np.ndarray:
    rows = np.zeros((count, len(FEW)))
    number = np.arange(begin, begin + count)
    rows[:, AT["tick"]], rows[:, AT["t_s"]] = number, number / RATE
    rows[:, AT["drive"]] = np.random.default_rng(begin).normal(size=count)
    return rows


def _limits(**changes: float) -> SimpleNamespace:
    plain = {"directory": "rec", "file_mb": 512.0, "file_s": 1e9, "budget_gb": 1.0, "tier_budget_gb": 1.0}
    return SimpleNamespace(**{**plain, **changes})


def _record(limits: SimpleNamespace, start_s: float, seconds: int, turn_s: int) -> int:
    """Record for some seconds of rig time as the recorder does: a new file each `turn_s`, and where the writer is full."""
    clock, lost, errors = [0.0], 0, []

    def opened() -> RecordingWriter:
        return RecordingWriter(
            limits, {"law": "{}"}, "rig", lambda text: errors.append(text) if text else None, FEW, lambda: clock[0],
            lambda: start_s + clock[0],
        )  # fmt: skip

    writer = opened()
    for second in range(2 * seconds):
        clock[0] = second / 2
        if writer.full or second and second % (2 * turn_s) == 0:
            lost += writer.close()
            writer = opened()
        lost += writer.write(_rows(second * RATE // 2, RATE // 2))
        writer.flush()
        lost += writer.write(np.empty((0, len(FEW))))
        tell(acknowledged=(second + 1) * RATE // 2 - lost, lost=lost, why=errors)
    lost += writer.close()
    tell(lost=lost, why=errors, ended=True)
    return 0


def _recorded(folder: Path, told: dict[str, object], kind: str) -> int:
    return sum(info(p).rows for p in recording_files(folder / "rec", kind) if "2026112" in p.name)


def _recorder_sound(folder: Path, told: dict[str, object]) -> None:
    """What was acknowledged can be read; what was lost is counted, with a reason."""
    rows = _recorded(folder, told, FULL)
    assert rows >= int(told.get("acknowledged", 0)), f"{rows} rows of {told['acknowledged']} acknowledged"
    if told.get("ended"):
        assert rows + int(told["lost"]) >= 3 * RATE, f"{rows} rows, {told['lost']} lost"
        assert told["why"] or not told["lost"], "lost without a reason"
    if told.get("ended") and not told["why"]:  # an error costs the copy the seconds that it held back
        assert _recorded(folder, told, TIER) >= rows / (RATE / 10)


def _budget_sound(folder: Path, told: dict[str, object]) -> None:
    """The oldest go first, whole, and only for a new recording that is there."""
    first = [
        f"rig-20200101T0000{10 * k:02d}.000Z" if k < 6 else f"rig-20200101T0001{10 * (k - 6):02d}.000Z"
        for k in range(OLD)
    ]
    found = [p.name.removesuffix(FULL) for p in recording_files(folder / "rec", FULL)]
    old = [name for name in found if name in first]
    assert old == first[OLD - len(old) :], f"not the oldest was deleted: {old}"
    assert len(old) == OLD or len(found) > len(old), "old recordings were deleted, and there is no new one"


OLD = 2  # recordings before


def _old_recordings(files: int = 1) -> None:
    for k in range(files):
        _record(_limits(), 1577836800.0 + 10.0 * k, 1, 99)


NOW = 1795660000.0  # 2026-11-25


def _size() -> float:
    return sum(p.stat().st_size for p in recording_files(Path("rec"), FULL)) / 1e9


# ------------------------------------------------------------------------------------- calibrations, configurations
def _rig() -> None:
    text = effective(load_settings(SIMULATED))
    text = re.sub(r"(?m)^( *path: ).*simulated\.sock$", r"\1rig.sock", text)
    Path("rig.yaml").write_text(re.sub(r"(?m)^( *directory: ).*$", r"\1rec", text))


def _calibration() -> None:
    modelfile.install("models", MODEL, "simulated", [])
    modelfile.install("models", dataclasses.replace(MODEL, f1=0.5), "simulated", [])


def _models_sound(folder: Path, told: dict[str, object]) -> None:
    for path in modelfile.history(folder / "models"):
        modelfile.load_calibration(path)
    modelfile.load_calibration(folder / "models")


def _calibration_folder() -> wizard.Wizard:
    tests = dict.fromkeys(wizard.TESTS)
    found = wizard.Wizard(load_settings("rig.yaml"), None, Path("calibration"), tests, 2, print)  # type: ignore[arg-type]
    gains = {"kp": 0.01, "ti_s": 0.004, "td_s": 0.001, "how": "present"}
    found.done = {
        "pid": steps.Pid("", gains, {**gains, "kp": 0.02, "how": "proposed"}),
        "proof": steps.Proof("", (1.0, 1.0), (0.1, 0.1), "", [], [], [], True),
    }
    return found


def _accept() -> None:
    _calibration_folder().accept(Path("models"), True)


def _before_accept() -> None:
    _rig()
    text = Path("rig.yaml").read_text()
    Path("rig.yaml").write_text(text)
    (Path("rig.yaml").parent / "experiments.yaml").write_text((ROOT / "config/experiments.yaml").read_text())
    Path("calibration").mkdir()
    modelfile.save_model("calibration/model.yaml", MODEL, "simulated", [])
    for name in steps.FITTED:
        Path(f"calibration/{name}.parquet").write_bytes(b"")
    _calibration_folder()._save()


# ---------------------------------------------------------------------------------------------------- diagnosis
def _diagnosed() -> tuple[object, ...]:
    """The arguments of the function that writes a diagnosis, of one that was stopped at once."""
    kept: list[tuple[object, ...]] = []
    real, diagnosis._write = diagnosis._write, lambda *a: kept.append(a)
    try:
        diagnosis.diagnose(load(PLANT), [read_table(LOG)], Path("none"), stopped=lambda: True)
    finally:
        diagnosis._write = real
    return kept[0]


FOUND: list[tuple[object, ...]] = []
PAGE: list[str] = []


def prepare_diagnosis() -> None:
    """Diagnose once, and draw its report once, before the forks."""
    FOUND.append(_diagnosed())
    real, diagnosis.write_report.__globals__["write_text"] = (
        diagnosis.write_report.__globals__["write_text"],
        lambda path, text: PAGE.append(text),
    )
    diagnosis.write_report(FOUND[0][2], FOUND[0][3], "report.html")
    diagnosis.write_report.__globals__["write_text"] = real
    diagnosis.write_report = lambda found, result, path: real(path, PAGE[0])


def _write_diagnosis() -> None:
    _, *rest = FOUND[0]
    diagnosis._write(Path("result"), *rest)


def _api_save() -> None:
    found, content = FOUND[0][2], FOUND[0][3]
    of = SimpleNamespace(plant=SimpleNamespace(description=found.final.plant), json=content)
    diagnosing.Diagnosis.save(of, "result")  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------------------- all
def command(*arguments: str) -> int:
    """Run a command of the program in this process."""
    return cli.main(list(arguments))


def commanded(name: str, *arguments: str, before: object = None, sound: object = None) -> Writer:
    """A writer that is one command."""
    more = {k: v for k, v in (("before", before), ("sound", sound)) if v}
    return Writer(name, partial(command, *arguments), **more)  # type: ignore[arg-type]


def _recording() -> None:
    _record(_limits(), NOW, 2, 99)
    (path,) = recording_files(Path("rec"), FULL)
    path.rename("run.arrows")
    (path,) = recording_files(Path("rec"), TIER)
    path.unlink()
    Path("rec").rmdir()


def _exported(name: str) -> Writer:
    def before() -> None:
        _recording()
        assert command("recordings", "export", "run.arrows", name, "--to", "1") == 0

    return commanded(
        f"recordings export {Path(name).suffix}", "recordings", "export", "run.arrows", name, before=before
    )


def _cut() -> None:
    _recording()
    Path("cut.arrows").write_bytes(Path("run.arrows").read_bytes()[:-300])
    Path("run.arrows").unlink()


def _init() -> int:
    shipped.COPIED = {"config/points": "config/points", "docs/examples": "examples"}  # some of its folders
    return command("init", "new")


def _service(*, root: str = "root") -> int:
    return service.install(Path("rig.yaml"), Path(root))


def _new_device() -> int:
    devices_new._text = lambda ask: (ROOT / "config/devices/encoder-serial.yaml").read_text()
    return devices_new.new("device.yaml")


def _bundle() -> None:
    _rig()
    settings = load_settings("rig.yaml")
    Path(settings.recording.directory).mkdir(parents=True, exist_ok=True)


def _save_effect() -> None:
    effect = {"format": "thermoctl-effect/1", "effect": "x", "title": "t"}
    save_effect({"remainder": {"law": {"effect": effect}}}, "windage", Path("effects"))


INPUTS = """\
format: thermoctl-experiments/1
experiments:
  step:
    title: Step
    sample_s: 5
    inputs:
      heat: {unit: W, corners: [[0, 0], [20, 0], [21, 5], [300, 5]]}
      air_temperature: {unit: degC, corners: [[0, 22], [300, 22]]}
"""


def _inputs() -> None:
    Path("step.yaml").write_text(INPUTS)


def _two_plants() -> None:
    Path("plant2.yaml").write_text((HEATER / "plant.yaml").read_text())


def _text(name: str, content: str) -> None:
    Path(name).write_text(content)


def _demo() -> None:
    if not Path("rig.yaml").exists():
        _rig()
    demo._own(load_settings("rig.yaml"))


def writers() -> list[Writer]:
    """All of them."""
    return [
        Writer("recorder and its 10 Hz copy", partial(_record, _limits(), NOW, 3, 2), _old_recordings, _recorder_sound, True),
        Writer("recorder at its budget", lambda: _record(_limits(budget_gb=_size(), tier_budget_gb=1.0), NOW, 2, 1),
               partial(_old_recordings, OLD), _budget_sound, True),
        Writer("kept estimates", lambda: keep.save(Path("rig.state"), MODEL, np.arange(5.0)) and 0,
               lambda: keep.save(Path("rig.state"), MODEL, np.arange(4.0))),
        Writer("identify: calibration installed", lambda: modelfile.install("models", MODEL, "simulated", []) and 0,
               _calibration, _models_sound),
        commanded("model rollback", "model", "rollback", before=_calibration, sound=_models_sound),
        Writer("tune --write", lambda: tuning.write(Path("rig.yaml"), tuning.Gains(0.02, 0.01, 0.0, "new")), _rig),
        Writer("calibrate: its state", lambda: _calibration_folder()._save(), _before_accept),
        Writer("calibrate --accept --gains", _accept, _before_accept),
        commanded("plant linearise --out --replace", "plant", "linearise", str(ROOT / "config/plants/actuator_thermal.yaml"),
                  "--rig", "simulated", "--out", "model.yaml", "--replace",
                  before=lambda: modelfile.save_model("model.yaml", MODEL, "simulated", [])),
        Writer("diagnose: the result", _write_diagnosis, lambda: None),
        Writer("diagnose: over an older result", _write_diagnosis, lambda: (_write_diagnosis(), _text("result/mine.txt", "mine"))),
        Writer("Diagnosis.save", _api_save),
        Writer("diagnose --save-effect", _save_effect),
        commanded("plant new", "plant", "new", "p.yaml", "--template", "block"),
        commanded("plant export --to c", "plant", "export", PLANT, "--to", "c", "--out", "p.c", before=partial(_text, "p.c", "old")),
        commanded("plant export --to fmu", "plant", "export", PLANT, "--to", "fmu", "--out", "p.fmu"),
        commanded("plant show --out .png", "plant", "show", PLANT, "--out", "p.png"),
        commanded("plant show --out .svg", "plant", "show", PLANT, "--out", "p.svg"),
        commanded("simulate --out", "simulate", LOG, "--plant", PLANT, "--out", "s.csv", before=partial(_text, "s.csv", "t,a\n0,1\n1,2\n")),
        commanded("refit --out", "refit", LOG, "--plant", PLANT, "--out", "plant2.yaml", before=_two_plants),
        commanded("experiment on a plant", "experiment", "step.yaml", "--plant", PLANT, "--out", "step.csv", before=_inputs),
        *map(_exported, ("out.parquet", "out.csv", "out.mf4", "out.mcap")),
        commanded("recordings import", "recordings", "import", LOG, "--out", "out.parquet"),
        commanded("recordings recover", "recordings", "recover", "cut.arrows", before=_cut),
        commanded("report: the support bundle", "report", "--config", "rig.yaml", "--out", "r.zip", before=_bundle),
        Writer("init", _init),
        Writer("demo: its configuration", _demo, _demo),
        Writer("service install", _service, _rig),
        Writer("devices new", _new_device),
    ]  # fmt: skip
