"""Make the plants of the simulated rigs from a plant file's truth."""

from __future__ import annotations

import re
from typing import Any

from thermoctl.plant import Plant, from_plain
from thermoctl.rig.signals import POINTS

HEATED = ("inner_magnet", "outer_stator", "bracket_1")  # bodies with unmeasured heat
FAST = ("i_coil", "u_integral", "velocity", "position")  # states that settle in milliseconds


def quasi_static(plant: Plant) -> Plant:
    """Replace amplifier and motion by inputs: coil current, eddy heat, and unmeasured heat."""
    data = plant.plain()
    data["nodes"] = {k: v for k, v in data["nodes"].items() if k not in FAST}
    flows: dict[str, Any] = {}
    for name, flow in data["flows"].items():
        if flow.get("into") in FAST or flow.get("from") in FAST:
            continue
        rate = str(flow["rate"]).replace("i_coil", "current")
        flows[name] = {**flow, "rate": "eddy_w" if "velocity" in rate else rate}
    for body in HEATED:
        flows[f"unmeasured_{body}"] = {"into": body, "rate": f"heat_{body}", "unit": "W"}
    data["flows"] = flows
    outputs = {
        k: {"value": v["value"], "unit": v["unit"]}
        for k, v in data["outputs"].items()
        if k in {f"{p}_c" for p in POINTS}
    }
    growth = str(data["outputs"]["output_reference_um"]["value"]).split("+", 1)[1]
    outputs["error_um"] = {"value": growth.strip(), "unit": "um"}
    joule = next(f["rate"] for f in flows.values() if f.get("into") == "coil" and "current" in str(f["rate"]))
    outputs["power_w"] = {"value": joule, "unit": "W"}
    data["outputs"] = outputs
    data["inputs"] = {
        "current": {"unit": "A"},
        "eddy_w": {"unit": "W"},
        "air": {"unit": "degC", "between_samples": "linear"},
        **{f"heat_{b}": {"unit": "W"} for b in HEATED},
    }
    expressions = [
        *(f["rate"] for f in flows.values()),
        *(o["value"] for o in outputs.values()),
        *(n["storage"] for n in data["nodes"].values()),
    ]
    words = set(re.findall(r"\w+", " ".join(map(str, expressions))))
    data["parameters"] = {k: v for k, v in data["parameters"].items() if k in words}
    return from_plain(data, plant.title)


def hidden_masses(plant: Plant) -> Plant:
    """Add two bodies that no thermometer sees: the stator's cover and the flexures' foot."""
    data = plant.plain()
    data["nodes"]["cover"] = {"unit": "degC", "storage": "C_cover", "initial": "air"}
    data["nodes"]["foot"] = {"unit": "degC", "storage": "C_foot", "initial": "air"}
    data["parameters"] |= {
        "C_cover": {"value": 95.0, "unit": "J/K"},
        "C_foot": {"value": 60.0, "unit": "J/K"},
        "G_cover": {"value": 0.35, "unit": "W/K"},
        "G_foot": {"value": 0.12, "unit": "W/K"},
    }
    data["flows"] |= {
        "stator_to_cover": {
            "from": "outer_stator",
            "into": "cover",
            "rate": "G_cover * (outer_stator - cover)",
            "unit": "W",
        },
        "shaft_to_foot": {
            "from": "shaft_2",
            "into": "foot",
            "rate": "G_foot * (shaft_2 - foot)",
            "unit": "W",
        },
    }
    return from_plain(data, plant.title)
