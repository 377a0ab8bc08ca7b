"""The tuner process: learns the expansion model from the ring while the reference encoder is connected.

compensation.tune starts it. It never touches the loop. A better model becomes a new calibration in the folder
of compensation.model. The daemon uses it from its next start; `thermoctl model rollback` undoes it. It is
proven by samples that came after it, also after a restart. Where it predicts those worse than the model
before, that one is current again. No further one is proposed until then. `status` shows the progress.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.tick.shared import TUNING, Shared
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modelfile
from thermoctl.identify.measured_loop import SLIPS
from thermoctl.identify.online import Tuner
from thermoctl.rig.channels import AT as CHANNEL_AT
from thermoctl.rig.channels import DEFAULT, Channels
from thermoctl.rig.signals import AT, of_channels

INTERVAL_S = 0.5
PROPOSE_S = 600.0  # rig time between two checks of the proposal
_TICK, _SLIPS = AT["tick"], AT["slips"]
_T, _AIR = AT["t_s"], AT["air_c"]
_POSITION, _REFERENCE = AT["position_raw_um"], AT["output_reference_um"]
_BOTH = [CHANNEL_AT["position_um"], CHANNEL_AT["output_reference_um"]]


class Tuning:
    """Learns the expansion model from a rig's record rows and saves calibrations.

    Give the rows to `take` in order of time; `tuner` holds the state of learning. folder: where calibrations
    are saved, or None to learn without saving; say(text): writes to the log."""

    def __init__(
        self,
        model: CompensatorModel,
        rig: str,
        folder: Path | None,
        say: Callable[[str], None],
        tuner: Tuner | None = None,
        channels: Channels = DEFAULT,
    ):
        self.rig, self.folder, self.say = rig, folder, say
        self.row = of_channels(channels)
        self.tuner = tuner or Tuner(model)
        self.period_s = model.expansion_period_s
        self.unproven = self._unproven()
        self.zero_um = self.air_c = float("nan")
        self.proposed_s = 0.0
        self._rows: list[np.ndarray] = []

    def _unproven(self) -> tuple[CompensatorModel, Path, Path] | None:
        """Return the model before a current one that was tuned online, its file and that of the tuned one."""
        if self.folder is None:
            return None
        try:
            path = modelfile.current(self.folder)
            name = modelfile.load_calibration(path).figures.get("tuned_from")
            before = self.folder / str(name)
            return None if name is None else (modelfile.load_model(before), before, path)
        except InputError:
            return None

    def take(self, rows: np.ndarray) -> None:
        """Take rows (K, signals) of consecutive ticks; each period of the model makes one sample."""
        if not len(rows):
            return
        rows = np.vstack([*self._rows, rows])
        number = np.floor(rows[:, _T] / self.period_s)
        ends = np.flatnonzero(np.diff(number)) + 1
        for part in np.split(rows, ends)[:-1]:
            self._sample(part)
        self._rows = [rows[ends[-1] if len(ends) else 0 :]]

    def _sample(self, rows: np.ndarray) -> None:
        skipped, made = (float(rows[-1, k] - rows[0, k]) for k in (_SLIPS, _TICK))
        is_test = skipped <= SLIPS * (made + skipped)  # with more skipped ticks the test is not valid
        good = is_test & ~self.row.states(rows)[:, _BOTH].any(axis=1)
        error = (
            float(np.mean((rows[:, _REFERENCE] - rows[:, _POSITION])[good])) if good.any() else float("nan")
        )
        air = float(np.nanmean(rows[:, _AIR]))
        estimates = rows[:, self.row.estimates].mean(0)
        if not (np.isfinite(air) and np.isfinite(estimates).all()):
            return
        if np.isnan(self.air_c):
            self.air_c = air
        if np.isnan(self.zero_um):
            self.zero_um = error
        # The model needs the distance from the first air temperature: rise + change of the air. The estimates
        # are degC.
        self.tuner.update(estimates - air, error - self.zero_um, air - self.air_c)
        if rows[-1, _T] - self.proposed_s >= PROPOSE_S:
            self.proposed_s = float(rows[-1, _T])
            self._propose()

    def _prove(self, before: CompensatorModel, old: Path, path: Path) -> None:
        """Compare the newest calibration with the one before, by the samples since; keep the better one."""
        was, is_now = self.tuner.error_um(before), self.tuner.error_um(self.tuner.model)
        if len(self.tuner.recent) < self.tuner.hold or not np.isfinite(was + is_now):
            return  # too few samples with a reference
        self.unproven = None
        if is_now > was and modelfile.current(old.parent) == path:
            back = modelfile.roll_back(old.parent, old.name)
            self.say(
                f"{path}: {is_now:.3g} um since then against {was:.3g} um with the one before; {back} is current again"
            )
            self._restart(before)

    def _restart(self, model: CompensatorModel) -> None:
        t = self.tuner
        self.tuner = Tuner(model, tuple(t.edges), t.full, t.clip, t.hold * self.period_s)

    def _propose(self) -> None:
        if self.unproven is not None:
            self._prove(*self.unproven)
            return
        new, why = self.tuner.proposal()
        if new is None:
            return
        if self.folder is not None:
            old = modelfile.current(self.folder)
            figures = {"tuned_online": why, "samples": self.tuner.bank.samples, "tuned_from": old.name}
            path = modelfile.install(self.folder, new, self.rig, figures=figures)
            self.unproven = self.tuner.model, old, path
            self.say(
                f"{path}: {why}; in use from the next start on, `thermoctl model rollback` takes it back"
            )
        self._restart(new)


def check(settings: Settings) -> None:
    """Check that compensation.tune has a folder for its results. Raises InputError."""
    if settings.compensation.tune and not Path(settings.compensation.model or "-").is_dir():
        raise InputError(
            f"{settings.path}: compensation.tune needs compensation.model to be a folder of calibrations (as `thermoctl identify` "
            f"and `thermoctl calibrate --accept` make it), not '{settings.compensation.model}'"
        )


def run(shared: Shared, tuning: Tuning, stopping: Callable[[], bool]) -> None:
    """Learn until `stopping()`."""
    position = shared.ring.head
    while not stopping():
        rows, position, _ = shared.ring.read(position)
        tuning.take(rows)
        shared.counters[TUNING] = 1.0 + tuning.tuner.progress
        time.sleep(INTERVAL_S)
