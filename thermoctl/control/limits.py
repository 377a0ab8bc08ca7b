"""Protection limits that are one number each: the table of the configuration and of the law.

`settings.ProtectionSettings` and `control.model.Parameters` inherit these fields, and the law reads them by
the same names. A new limit is one row here and its condition in law.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from thermoctl.rig.option import option


@dataclass(frozen=True)
class Limits:
    """Limits and time constants of the protection, with the defaults of a configuration."""

    following_um: float = option(
        "largest following error (position minus reference) for longer than following_s; twice this value trips at "
        "once",
        20.0,
        "um",
        0.0,
        1e6,
    )
    following_s: float = option(
        "time for which the following error may exceed following_um", 0.05, "s", 0.0, 60.0
    )
    coil_limit_c: float = option("largest coil temperature, measured or estimated", 80.0, "degC", 0.0, 250.0)
    coil_rate_k_s: float = option(
        "largest heating rate of the coil, averaged over coil_rate_time_s", 0.5, "K/s", 0.0, 100.0
    )
    coil_rate_time_s: float = option(
        "time constant of the average that coil_rate_k_s limits", 30.0, "s", 0.1, 3600.0
    )
    innovation_limit_c: float = option(
        "largest difference of measured and estimated coil temperature, averaged over innovation_time_s",
        5.0,
        "K",
        0.0,
        1e3,
    )
    innovation_time_s: float = option(
        "time constant of the average that innovation_limit_c limits", 30.0, "s", 0.1, 3600.0
    )
    power_limit_w: float = option(
        "largest electrical power of the coil, averaged over power_time_s", 15.0, "W", 0.0, 1e5
    )
    power_time_s: float = option(
        "time constant of the average that power_limit_w limits", 10.0, "s", 0.01, 3600.0
    )
    idle_current_a: float = option(
        "largest coil current while the amplifier is disabled", 0.05, "A", 0.0, 1e3
    )
    idle_power_w: float = option("largest coil power while the amplifier is disabled", 0.5, "W", 0.0, 1e5)
    idle_s: float = option(
        "time for which idle_current_a or idle_power_w may be exceeded; without, it is counted down at a quarter",
        0.5,
        "s",
        0.0,
        60.0,
    )
    saturation_s: float = option(
        "longest time for which the drive may stay at control.output_limit", 0.5, "s", 0.0, 3600.0
    )
    amplifier_s: float = option(
        "longest time from arming until the amplifier reports that its output is enabled", 1.0, "s", 0.0, 60.0
    )
    late_s: float = option(
        "longest time between two ticks; a longer one is a fault. The supervisor ends a loop without a tick for this "
        "time, but not before 1 s",
        0.1,
        "s",
        0.0,
        60.0,
    )
    agree_time_s: float = option(
        "time constant of the averages in which voltage, current, position and reference encoder are compared with each "
        "other",
        0.5,
        "s",
        1e-3,
        60.0,
    )
    drift_limit_c: float = option(
        "largest difference of the coil's reading from the model's prediction without corrections by that reading",
        8.0,
        "K",
        0.0,
        1e3,
    )
    monitored_limit_c: float = option(
        "largest difference of any other measured temperature from its estimate, averaged over "
        "innovation_time_s",
        8.0,
        "K",
        0.0,
        1e3,
    )
    resistance_ohm: float = option(
        "the coil's resistance R at 20 degC, corrected for its temperature. The measured voltage is compared with "
        "R x current; without a voltage reading the power is computed as R x current^2; 0: R is unknown, neither is done",
        0.0,
        "ohm",
        0.0,
        1e6,
    )
    resistance_current_a: float = option(
        "smallest mean coil current at which the coil's resistance is its thermometer, where no device is bound to the coil's temperature",
        0.1,
        "A",
        0.0,
        1e3,
    )
    resistance_tolerance: float = option(
        "relative tolerance of the comparison of voltage with resistance_ohm x current, as a share of the larger one",
        0.2,
        "1",
        0.0,
        1.0,
    )
    resistance_v: float = option(
        "absolute tolerance of the comparison of voltage with resistance_ohm x current, added to "
        "resistance_tolerance",
        0.3,
        "V",
        0.0,
        1e3,
    )
    current_per_drive: float = option(
        "coil current that a current amplifier produces per unit of drive; compared with the measured current while "
        "armed; 0 switches the comparison off",
        0.0,
        "A",
        -1e3,
        1e3,
    )
    current_tolerance_a: float = option(
        "largest difference of the measured current from current_per_drive x drive, averaged over agree_time_s",
        0.1,
        "A",
        0.0,
        1e3,
    )
    flexure_um_per_a: float = option(
        "displacement of a flexure stage per ampere of coil current, compared with the measured position; 0 switches "
        "the comparison off",
        0.0,
        "um/A",
        -1e6,
        1e6,
    )
    position_tolerance_um: float = option(
        "largest difference of the position from flexure_um_per_a x current, averaged over agree_time_s",
        40.0,
        "um",
        0.0,
        1e6,
    )
    reference_tolerance_um: float = option(
        "largest difference of the reference encoder from the estimated output, averaged over agree_time_s",
        10.0,
        "um",
        0.0,
        1e6,
    )
    order_limit_c: float = option(
        "limit for exchanged sensors: a fault when the measured and the estimated difference of two temperatures have "
        "opposite signs and their product is larger than this limit squared",
        1.2,
        "K",
        0.0,
        1e3,
    )
