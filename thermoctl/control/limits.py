"""Protection limits that are one number each: the table of the configuration and of the law.

`settings.ProtectionSettings` and `control.model.Parameters` inherit these fields, and the law reads them by the same
names. A new limit is one row here and its condition in law.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from thermoctl.option import option


@dataclass(frozen=True)
class Limits:
    """Limits and time constants of the protection; the default is what a configuration gets that names none."""

    following_um: float = option(
        "largest distance from the reference; twice as much trips at once", 20.0, "um", 0.0, 1e6
    )
    following_s: float = option("for how long it may be larger", 0.05, "s", 0.0, 60.0)
    coil_limit_c: float = option("hottest coil, measured or estimated", 80.0, "degC", 0.0, 250.0)
    coil_rate_k_s: float = option("fastest heating of the coil", 0.5, "K/s", 0.0, 100.0)
    coil_rate_time_s: float = option("time constant of that rate", 30.0, "s", 0.1, 3600.0)
    innovation_limit_c: float = option(
        "largest mean difference of measured and estimated coil temperature", 5.0, "K", 0.0, 1e3
    )
    innovation_time_s: float = option("time constant of that mean", 30.0, "s", 0.1, 3600.0)
    power_limit_w: float = option("largest mean electrical power", 15.0, "W", 0.0, 1e5)
    power_time_s: float = option("time constant of that mean", 10.0, "s", 0.01, 3600.0)
    idle_current_a: float = option(
        "largest coil current while the amplifier is disabled", 0.05, "A", 0.0, 1e3
    )
    idle_power_w: float = option("largest power while the amplifier is disabled", 0.5, "W", 0.0, 1e5)
    idle_s: float = option("for how long either may be larger", 0.5, "s", 0.0, 60.0)
    saturation_s: float = option("longest time at the drive's limit", 0.5, "s", 0.0, 3600.0)
    amplifier_s: float = option(
        "longest time after arming until the amplifier reports that it drives", 1.0, "s", 0.0, 60.0
    )
    late_s: float = option(
        "longest time between two ticks; above 1 s also what the supervisor lets the loop stand still",
        0.1,
        "s",
        0.0,
        60.0,
    )
    agree_time_s: float = option(
        "time constant of the means in which readings are compared with each other", 0.5, "s", 1e-3, 60.0
    )
    drift_limit_c: float = option(
        "largest difference of the coil's reading from the model without corrections", 8.0, "K", 0.0, 1e3
    )
    monitored_limit_c: float = option(
        "largest mean difference of a watched temperature from its estimate", 8.0, "K", 0.0, 1e3
    )
    resistance_ohm: float = option(
        "the coil's resistance at 20 degC: voltage and current are compared with it, and without a voltage reading "
        "the power is R I^2; 0: not known",
        0.0,
        "ohm",
        0.0,
        1e6,
    )
    resistance_tolerance: float = option(
        "how far voltage and resistance x current may be apart, as a share of the larger", 0.2, "1", 0.0, 1.0
    )
    resistance_v: float = option("and this much more", 0.3, "V", 0.0, 1e3)
    current_per_drive: float = option(
        "what a current amplifier makes of a unit of drive, compared while armed; 0: not", 0.0, "A", -1e3, 1e3
    )
    current_tolerance_a: float = option(
        "largest mean difference of the coil's current from the one asked for", 0.1, "A", 0.0, 1e3
    )
    flexure_um_per_a: float = option(
        "how far the current moves a stage on flexures, compared with the position; 0: not",
        0.0,
        "um/A",
        -1e6,
        1e6,
    )
    position_tolerance_um: float = option(
        "largest mean difference of position and current x flexure_um_per_a", 40.0, "um", 0.0, 1e6
    )
    reference_tolerance_um: float = option(
        "largest mean difference of the output reference from the estimated output", 10.0, "um", 0.0, 1e6
    )
    order_limit_c: float = option(
        "how far two temperatures may stand the other way round than their estimates", 1.2, "K", 0.0, 1e3
    )
