"""Hazards in simulated time: the real loop and law on a simulated rig whose readings and commands can be spoiled.

Every scenario is measured the same way: from the tick in which the hazard begins to the tick in which it is named and,
where it has to be, the amplifier disabled; how far the stage's output moved meanwhile; and that after mending and
acknowledging the rig is armed again without a jump. The rows become docs/proof/hazards.md (`make hazards`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

from tests.simulated import QUICK, QUICK_LIMITS, ROOT, quick_plant, rig_file
from thermoctl.configuration.settings import load_settings
from thermoctl.control import arming, faults
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.plant import load
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import ROLE
from thermoctl_hal.simulated.faulty import Fault, FaultInjector

JUMP_UM = 0.5  # arming may not move the stage more than this


@dataclass(frozen=True)
class Row:
    """One line of the table. `limit`, `measured`: what was allowed and what came, in words with units."""

    section: str
    hazard: str
    limit: str
    measured: str
    outcome: str
    message: str


ROWS: list[Row] = []
"""What the scenarios of this run have measured."""


def quick_settings(folder: Path):
    """Configuration, plants and compensator model of the simulated rig with heat capacities QUICK times smaller: a
    thermal hour passes in 72 s of simulated time. Limits on thermal rates and slews follow."""
    from thermoctl.identify.linearise import linearise
    from thermoctl.identify.modelfile import save_model

    for name in ("actuator.yaml", "actuator_thermal.yaml"):
        (folder / name).write_text(quick_plant(ROOT / "config/plants" / name))
    model = linearise(load(folder / "actuator_thermal.yaml"), 0.001, 0.1, expansion_period_s=0.02)
    model = dataclasses.replace(model, air_filter_s=model.air_filter_s / QUICK)
    save_model(folder / "model.yaml", model, "simulated", [folder / "actuator_thermal.yaml"])
    path = rig_file(
        folder,
        *QUICK_LIMITS,
        ("plants/", ""),
        ("models/simulated.yaml", "model.yaml"),
        ("coil_limit_c: 80", "coil_limit_c: 80\n  coil_rate_k_s: 25\n  innovation_time_s: 0.6"),
    )
    return load_settings(path)


class HazardRig(Simulation):
    """A simulation that can be spoiled: `inject` begins a fault of thermoctl_hal.simulated.faulty in the next tick, `mend` ends all."""

    def __init__(self, settings, model=None, parameters=None, publish=None):
        super().__init__(settings, model, parameters, publish)
        self.injector = FaultInjector(self.backend, [], seed=3)
        self.rig.backend = self.injector

    def inject(self, kind: str, *roles: str, by: float = 0.0) -> None:
        self.injector.faults.append(
            Fault(
                kind,
                tuple(ROLE[r] for r in roles),
                max(self.injector._t, 0.0),
                math.inf,
                by,
                stale_after_s=0.01 if "_um" in roles[0] else 0.05,
            )
            if roles
            else Fault(kind, (), 0.0, math.inf, by)
        )

    def mend(self) -> None:
        self.injector.faults.clear()
        self.injector._held.clear()
        self.injector._late.clear()

    @property
    def state(self) -> str:
        return arming.STATES[int(self.row[INDEX["state"]])]

    @property
    def faults(self) -> set[str]:
        return {f.name for f in faults.decode(self.row[INDEX["fault_bits"]])}

    def __getitem__(self, signal: str) -> float:
        return float(self.row[INDEX[signal]])

    @property
    def output_um(self) -> float:
        """Where the plant's output truly is."""
        return self.backend.rig.true("output_reference_um")

    def ready_to_be_spoiled(self, setpoint_um: float = 20.0) -> None:
        """Armed, on its way to `setpoint_um` and past the transient of arming; nothing stands."""
        self.arm()
        self.command("setpoint", setpoint_um)
        self.tick(400)
        assert self.state == "ARMED" and not self.faults, (self.state, self.faults)

    def detect(self, names: set[str], limit_ticks: int) -> tuple[int, set[str], float]:
        """(ticks until one of the faults `names` is shown, those shown then, the largest way of the output from where the
        reference wanted it, um). The amplifier must be off in the very tick in which a fault that trips is shown."""
        way, begun, wanted = 0.0, self.output_um, self["reference_um"]
        for k in range(1, limit_ticks + 1):
            self.tick()
            way = max(
                way,
                abs((self.output_um - begun) - (self["reference_um"] - wanted))
                if self.state == "ARMED"
                else 0.0,
            )
            found = self.faults & names
            if found:
                if any(
                    faults.BY_NAME[n].severity != "warning" and not n.startswith("monitored") for n in found
                ):
                    assert self.state == "FAULT" and self["enable"] == 0.0 and self["drive"] == 0.0
                return k, found, way
        raise AssertionError(
            f"none of {sorted(names)} within {limit_ticks} ticks: state {self.state}, {sorted(self.faults)}, "
            f"the output moved {way:.2f} um"
        )

    def comes_back(self, limit_s: float = 20.0) -> float:
        """Mended: acknowledge, arm, and hold for 0.3 s; the largest step of the output from where it stood, um."""
        self.mend()
        self.tick(50)
        assert self["enable"] == 0.0 and self.state != "ARMED"  # nothing arms by itself
        if self.state == "FAULT":  # latched: arming does not acknowledge
            self.command("arm")
            self.tick(3)
            assert self.state == "FAULT"
        calm = 0
        for _ in range(round(limit_s / 0.1)):
            self.command("disarm")
            self.tick(100)
            calm = calm + 1 if self.state == "READY" and not self.faults else 0
            if calm == 4:
                break
        assert calm == 4, (self.state, self.faults)
        stood, worst = self.output_um + self["compensation_um"], 0.0
        self.command("arm")
        for _ in range(300):  # what the compensation adds at its limited slew is no jump
            self.tick()
            worst = max(worst, abs(self.output_um + self["compensation_um"] - stood))
        assert self.state == "ARMED" and worst < JUMP_UM, (self.state, self.faults, worst)
        return worst


def say(
    section: str,
    hazard: str,
    limit_ticks: int,
    ticks: int,
    found: set[str],
    way_um: float,
    jump_um: float | None,
) -> None:
    """Keep the scenario's row."""
    name = sorted(found, key=lambda n: faults.BIT[n])[0]
    fault = faults.BY_NAME[name]
    trips = fault.severity != "warning" and not name.startswith("monitored")
    back = "" if jump_um is None else f"; re-armed, moved {jump_um:.2f} um"
    ROWS.append(
        Row(
            section,
            hazard,
            f"{limit_ticks} ticks",
            f"{ticks} ticks, output off by {way_um:.2f} um",
            ("amplifier off" if trips else "warning") + back,
            f"`{name}`: {fault.remedy}",
        )
    )


def page(rows: list[Row], machine: str, date: str) -> str:
    """The table as Markdown."""
    text = (
        "<!-- Written by `make hazards`; a figure here was measured by the tests in tests/hazards. -->\n# Hazards\n\n"
        f"Measured {date} on {machine}. A tick is 1 ms. Each row is a test in `tests/hazards`; it fails when the limit is not "
        "kept, when the amplifier is not safe, when nothing names the cause, or when the rig does not come back, or with a "
        "jump.\n"
    )
    for section in dict.fromkeys(r.section for r in rows):
        text += f"\n## {section}\n\n| hazard | limit | measured | outcome | message |\n| --- | --- | --- | --- | --- |\n"
        for r in rows:
            if r.section == section:
                text += (
                    "| " + " | ".join(str(c).replace("|", "\\|") for c in dataclasses.astuple(r)[1:]) + " |\n"
                )
    return text
