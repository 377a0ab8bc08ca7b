"""Recordings of real rigs: the effects that each plant lacks, and those that may be named beside them.

The recordings are public ones of others and do not come with the program. THERMOCTL_RECORDINGS names their
folder. Sources of the accepted effects: each folder's answers.yaml, else its README.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rig:
    """One diagnosis of real recordings, by the names of files in its folder.

    `accepted`: sets of effects, of each of which one has to be found; `tolerated`: effects that are no
    strays."""

    name: str
    folder: str
    runs: str
    accepted: tuple[frozenset[str], ...] = ()
    tolerated: tuple[str, ...] = ()
    held_out: str = ""
    plant: str = "plant.yaml"


_MASS, _LAG = frozenset({"hidden_thermal_mass"}), frozenset({"sensor_lag"})
_FRICTION = frozenset({"coulomb_friction", "stribeck_friction", "directional_friction"})
_WARM = frozenset({"radiation", "natural_convection", "temperature_dependent_conductance"})
_MEMBER = frozenset({"missing_member", "bending"})
_SOFT = frozenset({"expansion_lag", "sensor_lag"})


RIGS = (
    Rig("dyno_1", "actuator_dyno", "run_1", (_MASS,), ("sensor_lag", "copper_resistance")),
    Rig("dyno_2", "actuator_dyno", "run_2", (_LAG,), ("hidden_thermal_mass", "copper_resistance")),
    Rig("dyno_3", "actuator_dyno", "run_3", (_MASS, _LAG), ("copper_resistance",)),
    Rig(
        "battery",
        "battery_18650",
        "run_1 run_2",
        (),
        ("hidden_thermal_mass", "sensor_lag", "second_ambient"),
        "run_3 run_4",
    ),
    Rig("building", "building_prbs", "run_1", (_MASS,), ("sensor_lag",)),
    Rig(
        "tanks",
        "cascaded_tanks",
        "run_1",
        (frozenset({"overflow"}),),
        ("orifice_exponent", "sensor_saturation"),
        "run_2",
    ),
    Rig("daisy", "daisy_heating", "run_1", (_MASS, _WARM), ("sensor_lag",)),
    Rig("emps", "emps", "run_1", (_FRICTION,), ("constant_load", "viscous_friction")),
    Rig("klipper_1", "klipper_frame_expansion", "run_1", (_MEMBER, _SOFT)),
    Rig("klipper_2", "klipper_frame_expansion", "run_2", (_MEMBER, _SOFT)),
    Rig("klipper_3", "klipper_frame_expansion", "run_3", (_MEMBER, _SOFT), plant="plant_run_3.yaml"),
    Rig("pendulum", "pendulum_free_rotary", "run_1", (_FRICTION, frozenset({"quadratic_drag"})), (), "run_2"),
    Rig("silverbox", "silverbox", "run_1", (frozenset({"cubic_stiffness"}),), (), "run_2 run_3"),
    Rig("tclab_12", "tclab", "run_1 run_2", (frozenset({"missing_link"}), _LAG), ("radiation",)),
    Rig("tclab_3", "tclab", "run_3", (frozenset({"missing_link"}), _LAG), ("radiation",)),
    Rig("ak109", "tmotor_ak109", "run_1 run_2 run_3", (_MASS,), ("copper_resistance",)),
    Rig("ak809", "tmotor_ak809", "run_1", (_MASS,), ("copper_resistance",)),
    Rig(
        "hotend",
        "um_hotend",
        "run_1",
        (frozenset({"conductance_step"}), frozenset({"sensor_lag", "hidden_thermal_mass", "sensor_delay"})),
        tuple(_WARM),
    ),
    Rig(
        "meter_box",
        "meter_box",
        "run_1",
        (frozenset({"sensor_lag", "sensor_delay"}), _MASS),
        (*_WARM, "second_ambient", "actuator_delay"),
    ),
    Rig(
        "cogging",
        "odrive_cogging",
        "run_1 run_2 run_3 run_4 run_5 run_6 run_7 run_8",
        (frozenset({"cogging"}), _FRICTION),
        ("cubic_stiffness", "backlash_hysteresis", "viscous_friction"),
    ),
    Rig("pot", "pot_cooling", "run_1 run_2", (_MASS,), tuple(_WARM), "run_3"),
    Rig(
        "zprobe_h8a",
        "zprobe_h8a",
        "run_1",
        (frozenset({"expansion_lag", "missing_member", "hidden_thermal_mass", "creep"}),),
    ),
    Rig("zprobe_1", "zprobe_drift", "run_1", (_SOFT,), ("missing_member",)),
    Rig("zprobe_3", "zprobe_drift", "run_3", (_SOFT,), ("missing_member",)),
)
