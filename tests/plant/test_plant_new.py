"""`plant new`: templates that run, and a first plant from a stranger's recording, up to the right name."""

import csv
import json
import re
import time
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermoctl import cli
from thermoctl.plant import load, loads
from thermoctl.plant.first.new import TEMPLATES
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

SIGMA = 5.67e-8  # Stefan and Boltzmann, W/m^2/K^4


def stranger(path: Path) -> None:
    """A rig by another simulator (SciPy): two bodies, one heated; it radiates, which no first plant knows."""
    t = np.arange(0.0, 7200.0, 6.0)
    power = np.asarray([0.0, 60.0, 20.0, 90.0, 0.0, 40.0])[(t // 1200).astype(int) % 6]
    rng = np.random.default_rng(5)

    def slopes(now: float, x: np.ndarray) -> list[float]:
        p, (block, sink) = power[min(int(now // 6.0), len(t) - 1)], x
        radiated = 0.9 * SIGMA * 0.02 * ((block + 273.15) ** 4 - 295.15**4)
        link = 0.05 * (block - sink)
        return [(p - link - 0.1 * (block - 22) - radiated) / 90, (link - 0.25 * (sink - 22)) / 150]

    x = solve_ivp(slopes, (0, t[-1]), [22.0, 22.0], t_eval=t, max_step=6.0, rtol=1e-8).y
    x += rng.normal(0, 0.05, x.shape)
    begin = datetime(2026, 3, 14, 9, 26, 53)
    with open(path, "w", encoding="latin-1", newline="") as f:
        rows = csv.writer(f, delimiter=";")
        rows.writerow(["Zeit", "P_Heizung [kW]", "T_Luft [°C]", "T_Block [°C]", "T_Kühler [°C]"])
        for k, now in enumerate(t):
            numbers = (f"{power[k] / 1e3:.4f}", "22,00", f"{x[0, k]:.3f}", f"{x[1, k]:.3f}")
            rows.writerow(
                [(begin + timedelta(seconds=float(now))).isoformat(), *(n.replace(".", ",") for n in numbers)]
            )


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_strangers_rig_in_ten_minutes(folder, capsys):
    """Two edits up to the right name; `make stranger` does so with files of four tools."""
    stranger(folder / "log.csv")
    times = []

    def command(line: str) -> None:
        begin = time.monotonic()
        assert cli.main(line.split()) == 0
        times.append(f"{time.monotonic() - begin:6.1f} s  thermoctl {line}")

    command("plant new rig.yaml --from-csv log.csv")
    printed = capsys.readouterr()
    assert "time from 'Zeit'" in printed.err and "decimal comma" in printed.err
    assert "it heats 'Block'" in printed.out and "touch" in printed.out
    plant = load("rig.yaml")
    assert list(plant.inputs) == ["P_Heizung", "T_Luft"] and list(plant.nodes) == ["Block", "Kuehler"]
    assert 0.01 < plant.outputs["T_Block"].noise_sd < 0.1
    text = (folder / "rig.yaml").read_text()
    for name, value in (("C_Block", 90), ("C_Kuehler", 150)):  # two edits, from the parts' data sheets
        known = f"{name}: {{value: {value}, unit: J/K}}"
        text, edits = re.subn(rf"{name}: \{{value: \S+, unit: J/K, range: .*\]\}}", known, text)
        assert edits == 1
        times.append(f"   edit   {known}")
    (folder / "rig.yaml").write_text(text)
    command("plant check rig.yaml --data log.csv")
    command("diagnose --plant rig.yaml log.csv --out result --quiet")
    result = json.loads((folder / "result/diagnosis.json").read_text())
    assert [(f["effect"], f["where"]) for f in result["findings"]] == [("radiation", "Block")]
    print("\n".join(times))


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_is_checked_and_runs(folder, name, capsys):
    assert cli.main(["plant", "new", "p.yaml", "--template", name]) == 0
    plant = load("p.yaml")
    t = np.linspace(0, 100, 201)
    columns = {
        i.column: np.full(len(t), 1e-5 if "m^3" in (i.unit or "") else 20.0) for i in plant.inputs.values()
    }
    columns |= {
        o.column: np.full(len(t), 0.1 if "m" in (o.unit or "") else 20.0) for o in plant.outputs.values()
    }
    y = compile_plant(plant).simulate(Table("x", "x", t, columns)).y
    assert np.isfinite(y).all() and np.ptp(y) > 0
    assert all(q.unit for q in (*plant.readings(), *plant.parameters.values(), *plant.nodes.values()))


def test_templates_are_the_shipped_files_and_the_help_names_them(capsys):
    from thermoctl.files.shipped import shipped

    assert {p.stem for p in shipped("config/plants/templates").glob("*.yaml")} == set(TEMPLATES)
    with pytest.raises(SystemExit):
        cli.main(["plant", "new", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert all(t in printed for t in TEMPLATES)


@pytest.mark.parametrize(
    "args, text, says",
    [
        ([], "", "--from-csv RECORDING or --template NAME"),
        (
            ["--from-csv", "a.csv", "--template", "block"],
            "t,T [degC]\n0,1\n1,2\n",
            "no column is recognised as it",
        ),
        (["--from-csv", "a.csv"], "t,a,b\n0,1,3\n1,2,3\n", "--outputs 'a [UNIT]'; or take a template"),
        (["--from-csv", "a.csv"], "t,U [V]\n0,1\n1,2\n", "known in 'U' [V] (voltage); take a template"),
        (
            ["--from-csv", "a.csv", "--outputs", "a [g]"],
            "t,a\n0,1\n1,2\n",
            "known in 'a' [g]; take a template",
        ),
        (["--from-csv", "a.csv", "--outputs", "a [foo]"], "t,a\n0,1\n1,2\n", "'foo' is not a unit"),
        (
            ["--from-csv", "a.csv", "--outputs", "force"],
            "t,force\n0,1\n1,2\n",
            "known in 'force' [N] (force); write its unit, as [degC] or [m]: --outputs 'force [UNIT]'",
        ),
        (
            ["--from-csv", "a.csv", "--inputs", "b"],
            "t,T [degC],b\n0,1,3\n1,2,3\n",
            "tells what 'b' is (from 3 to 3)",
        ),
        (
            ["--from-csv", "a.csv"],
            "t,P [W],T\n0,1,\n1,2,\n",
            "none is known in 'P' [W] (power), 'T' (no values); take",
        ),
        (["--template", "blok"], "", "did you mean 'block'"),
        (["--from-csv", "a.csv"], "t,x [m],b\n0,1,1\n1,2,2\n", "recognised as what moves it"),
        (["--from-csv", "a.csv"], "t,T [degC],b\n0,1,1\n1,2,2\n", "'b [W]', or none: --inputs ''"),
        (["--from-csv", "a.csv"], "t,x [m]\n0,1\n1,2\n", "2 values; 8 or more were expected"),
        (
            ["--from-csv", "a.csv", "--outputs", "P"],
            "t,P [W],T [degC]\n0,1,2\n1,2,2\n",
            "none is known in 'P' [W] (power); take a template that is near",
        ),
        (["--from-csv", "a.csv", "--inputs", "Q"], "t,P [W],T [degC]\n0,1,2\n1,2,2\n", "no column 'Q'"),
        (["--from-csv", "a.csv"], "t,P [W],T [degC]\n0,1,2\n1,2,2\n", "2 values; 8 or more were expected"),
    ],
)
def test_a_mistake_is_one_line(folder, capsys, args, text, says):
    (folder / "a.csv").write_text(text)
    assert cli.main(["plant", "new", "p.yaml", *args]) == 2
    assert says in capsys.readouterr().err and not (folder / "p.yaml").exists()
    (folder / "p.yaml").write_text("mine")
    assert cli.main(["plant", "new", "p.yaml", *args]) == 2
    assert "exists already" in capsys.readouterr().err and (folder / "p.yaml").read_text() == "mine"


def test_columns_without_units_are_named_by_hand(folder, capsys):
    t = np.arange(0.0, 900.0, 3.0)
    warm = 21 + 30 * (1 - np.exp(-t / 200))
    rows = "\n".join(f"{a:g},{20 if a else 0},{b:.4f},21" for a, b in zip(t, warm, strict=True))
    (folder / "a.csv").write_text(f"t,heater,2nd probe,room\n{rows}\n")
    args = ["plant", "new", "p.yaml", "--from-csv", "a.csv", "--inputs", "heater", "--outputs", "2nd probe"]
    assert cli.main(args) == 0
    plant = load("p.yaml")
    assert plant.outputs["q_2nd_probe"].column == "2nd probe" and "T_ambient" in plant.parameters
    # Steady state and time constant of the data: G = 20 / 30 W/K, C = 200 s * G.
    values = {n: p.value for n, p in plant.parameters.items()}
    assert values["G_body_q_2nd_probe"] == pytest.approx(20 / 30, rel=0.05)
    assert values["C_body_q_2nd_probe"] == pytest.approx(200 * 20 / 30, rel=0.05)


@pytest.mark.parametrize(("unit", "full"), [("%", 1.0), ("1", 100.0)])
def test_an_input_that_is_named_in_percent_or_as_a_number_is_a_duty(folder, capsys, unit, full):
    t = np.arange(0.0, 9.0, 0.03)
    turning = 300 * (1 - np.exp(-t / 0.4))
    rows = "\n".join(f"{a:g},{60 if a else 0},{b:.4f}" for a, b in zip(t, turning, strict=True))
    (folder / "a.csv").write_text(f"t,leftCommand,leftSpeed\n{rows}\n")
    named = ["--inputs", f"leftCommand [{unit}]", "--outputs", "leftSpeed [rpm]"]
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv", *named]) == 0
    (folder / "p.yaml").write_text((folder / "p.yaml").read_text().replace('"?"', "1"))
    values = {n: p.value for n, p in load("p.yaml").parameters.items()}
    assert values["inertia"] / values["damping"] == pytest.approx(0.4, rel=0.2)
    assert values["damping"] == pytest.approx(0.6 * full / (300 * np.pi / 30), rel=0.2)


HEATED = (  # drive, air, body in the words of loggers in many languages, none with a unit
    ("heat", "air_temperature", "temperature_1"),
    ("Heizleistung", "Umgebungstemperatur", "Blocktemperatur"),
    ("Leistung", "T_Luft", "T_Kühler"),
    ("puissance_chauffage", "température_ambiante", "température_bloc"),
    ("potenza", "temp_aria", "temp_blocco"),
    ("potencia", "temperatura ambiente", "temperatura del bloque"),
    ("vermogen", "omgevingstemperatuur", "bloktemperatuur"),
    ("moc grzałki", "temperatura otoczenia", "temperatura bloku"),
    ("heaterPower", "ambientTemp", "blockTemp"),
    ("Q1", "Tamb", "T1"),
    ("P_heizung", "Raumtemp", "TC1"),
    ("watts", "T_outdoor", "T_room"),
    ("effekt", "omgivning", "temp_block"),
)


def heated(folder, names, factor=1.0):
    """A recording of one heated body, 20 K above its air after a while."""
    t = np.arange(0.0, 900.0, 3.0)
    drive = np.where(t < 600, 10.0, 0.0) * factor
    warm = 21 + 20 * (1 - np.exp(-t / 200))
    head = ",".join(("t", *names))
    rows = "\n".join(
        f"{a:g},{b:g},{21.3 + 1e-4 * a:.3f},{c:.3f}" for a, b, c in zip(t, drive, warm, strict=True)
    )
    (folder / "a.csv").write_text(f"{head}\n{rows}\n", encoding="utf-8")
    (folder / "p.yaml").unlink(missing_ok=True)


@pytest.mark.parametrize("names", HEATED)
def test_columns_without_units_are_recognised_and_never_a_power(folder, names, capsys):
    heated(folder, names)
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    drive, air = plant.inputs.values()
    assert (drive.column, drive.unit) == (names[0], None) and (air.column, air.role) == (names[1], "ambient")
    assert [o.column for o in plant.outputs.values()] == [names[2]]
    assert [p.name for p in plant.parameters.values() if p.unit == "W"] == [f"W_{drive.name}"]
    printed = capsys.readouterr().out
    assert f"'{names[1]}' has no unit" in printed and f"watts for each unit of '{names[0]}'" in printed


def test_a_unit_by_hand_and_a_name_that_says_nothing(folder, capsys):
    heated(folder, ("a", "b", "c"))
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 2
    assert "write its unit" in capsys.readouterr().err and not (folder / "p.yaml").exists()
    args = ["--inputs", "a [mW], b [degC]", "--outputs", "c [degC]"]
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv", *args]) == 0
    plant = load("p.yaml")
    assert plant.inputs["a"].unit == "W" and plant.inputs["a"].conversion.unit == "mW"
    assert plant.inputs["b"].role == "ambient" and not [p for p in plant.parameters if p.startswith("W_")]


@pytest.mark.parametrize(
    ("drive", "rate", "parameter"),
    [
        ("Strom [A]", "R * Strom**2", "R"),
        ("heater current (mA)", "R * heater_current**2", "R"),
        ("corrente", "R * corrente**2", "R"),
        ("U_heiz [V]", "U_heiz**2 / R", "R"),
        ("PWM [%]", "P_full * PWM", "P_full"),
    ],
)
def test_what_needs_a_number_from_the_user_has_a_question_mark(folder, drive, rate, parameter, capsys):
    heated(folder, (drive, "air [degC]", "block [degC]"))
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    text = (folder / "p.yaml").read_text()
    assert (
        f'{parameter}: {{value: "?"' in text and "write it for the question mark" in capsys.readouterr().out
    )
    assert cli.main(["plant", "check", "p.yaml"]) == 2
    assert (
        "p.yaml:7:" in (error := capsys.readouterr().err)
        and f"value of '{parameter}' is not known yet" in error
    )
    (folder / "p.yaml").write_text(text.replace('"?"', "0.37"))
    plant = load("p.yaml")
    assert str(plant.flows[next(iter(plant.flows))].rate) == rate


def test_a_template_takes_the_columns_of_a_recording(folder, capsys):
    t = np.arange(0.0, 60.0, 1.0)
    rows = "\n".join(f"{a:g};3,0;41,0;22,0;30,0;35,0" for a in t)
    head = "Zeit;Strom [A];Gehäuse [°C];Raumluft [°C];Flansch [°C];Wicklung [°C]"
    (folder / "a.csv").write_text(f"{head}\n{rows}\n", encoding="utf-8")
    assert cli.main(["plant", "new", "p.yaml", "--template", "motor", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    columns = {r.name: r.column for r in plant.readings()}
    assert columns == {"current": "Strom", "air": "Raumluft", "T_winding": "Wicklung", "T_housing": "Gehäuse"}
    assert "does not read: Flansch" in (folder / "p.yaml").read_text()
    (folder / "p.yaml").unlink()
    args = ["--columns", "T_housing=Flansch"]
    assert cli.main(["plant", "new", "p.yaml", "--template", "motor", "--from-csv", "a.csv", *args]) == 0
    assert load("p.yaml").outputs["T_housing"].column == "Flansch"
    rows = "\n".join(f"{a:g},3,35" for a in t)  # neither air nor housing
    (folder / "a.csv").write_text(f"t,I [A],T_coil [degC]\n{rows}\n")
    (folder / "p.yaml").unlink()
    assert cli.main(["plant", "new", "p.yaml", "--template", "motor", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    assert list(plant.outputs) == ["T_winding"] and plant.parameters["air"].value == 35
    assert all(cli.main(["simulate", "--plant", "p.yaml", "a.csv"]) == 0 for _ in range(1))


def swung(t, mass, damping, stiffness):
    """Position and force of a mass with friction, and a spring where it has one."""
    force = 5 * np.sin(2.1 * t) + 3 * np.sin(0.7 * t)

    def slopes(now, x):
        return [x[1], (np.interp(now, t, force) - damping * x[1] - stiffness * x[0]) / mass]

    return force, solve_ivp(slopes, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, max_step=0.02).y


@pytest.mark.parametrize("stiffness", [0.0, 40.0])
@pytest.mark.parametrize("head", ["t,Kraft [N],Position [mm]", "t,force [N],x [mm]"])
def test_an_axis_becomes_mass_friction_and_a_spring_if_it_has_one(folder, stiffness, head):
    t = np.arange(0.0, 30.0, 0.02)
    force, (place, _) = swung(t, 2.0, 6.0, stiffness)
    rows = "\n".join(f"{a:g},{b:.4f},{1e3 * c:.4f}" for a, b, c in zip(t, force, place, strict=True))
    (folder / "a.csv").write_text(f"{head}\n{rows}\n")
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    values = {n: p.value for n, p in plant.parameters.items()}
    assert values["mass"] == pytest.approx(2.0, rel=0.1) and values["damping"] == pytest.approx(6.0, rel=0.1)
    assert values.get("stiffness", 0.0) == pytest.approx(stiffness, rel=0.1)


@pytest.mark.parametrize(
    "unit, kind, factor",
    [
        *(("deg/s", "rad/s", np.pi / 180), ("°/s", "rad/s", np.pi / 180), ("rpm", "rad/s", np.pi / 30)),
        *(("mrad/s", "rad/s", 1e-3), ("turn/min", "rad/s", np.pi / 30), ("mrad", "rad", 1e-3)),
        *(("km/h", "m/s", 1 / 3.6), ("mm/s", "m/s", 1e-3), ("turn", "rad", 2 * np.pi)),
    ],
)
def test_every_unit_of_an_angle_or_a_velocity_is_one(folder, unit, kind, factor):
    t = np.arange(0.0, 20.0, 0.02)
    force, x = swung(t, 2.0, 6.0, 0.0)
    drive = "N*m" if "rad" in kind else "N"
    moved = x[int("/s" in kind)] / factor
    rows = "\n".join(f"{a:g},{b:.5f},{c:.8g}" for a, b, c in zip(t, force, moved, strict=True))
    (folder / "a.csv").write_text(f"t,a,b\n{rows}\n")
    options = ["--inputs", f"a [{drive}]", "--outputs", f"b [{unit}]"]
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv", *options]) == 0
    plant = load("p.yaml")
    assert plant.outputs["b"].unit == kind
    size = plant.parameters["inertia" if "rad" in kind else "mass"].value
    assert (size, plant.parameters["damping"].value) == pytest.approx((2.0, 6.0), rel=0.1)


def test_columns_may_have_the_names_that_the_draft_uses(folder):
    t = np.arange(0.0, 20.0, 0.02)
    force, x = swung(t, 2.0, 6.0, 0.0)
    rows = "\n".join(f"{a:g},{b:.5f},{c:.8g}" for a, b, c in zip(t, force, x[1], strict=True))
    (folder / "a.csv").write_text(f"t,drive [Nm],speed [rad/s]\n{rows}\n")
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    (drive,), (speed,) = plant.inputs.values(), plant.outputs.values()
    assert (drive.column, speed.column) == ("drive", "speed")


def swing(t):
    """A mass of 1 on a spring of 40 N/m with 0.3 N*s/m, let go at 0.2 m; its rest is at 0.05 m."""
    w = (40 - 0.15**2) ** 0.5
    return 0.05 + 0.15 * np.exp(-0.15 * t) * (np.cos(w * t) + 0.15 / w * np.sin(w * t))


FREE = {  # header, options, values over time, and the parameters that made them
    "swing": ("x [mm]", "", lambda t: 1e3 * swing(t), {"stiffness": 40, "damping": 0.3, "rest": 0.05}),
    "gyro": (
        "w [deg/s]",
        "",
        lambda t: np.rad2deg(np.gradient(swing(t), t)),
        {"stiffness": 40, "damping": 0.3},
    ),
    "coasting": ("v [km/h]", "", lambda t: 30 * np.exp(-0.05 * t), {"damping": 0.05}),
    "rolling out": ("x [m]", "", lambda t: 4 * (1 - np.exp(-0.1 * t)), {"damping": 0.1}),
    "cooling": ("T [degC]", "", lambda t: 21 + 60 * np.exp(-t / 15), {"T_ambient": 21, "G_body_T": 1 / 15}),
    "warming": ("T [degC]", "", lambda t: 21 - 40 * np.exp(-t / 25), {"T_ambient": 21, "G_body_T": 1 / 25}),
    "in air": (
        "T [degC],air [degC]",
        "",
        lambda t: (21 + 9 * np.exp(-t / 9), 21 + 0 * t),
        {"G_body_T": 1 / 9},
    ),
    "emptying": ("h [cm]", "h [cm]", lambda t: 100 * (0.7 - 0.01 * t) ** 2, {"outlet_tank_h": 0.02}),
    "beside": ("x [mm],rh [%]", "x", lambda t: (1e3 * swing(t), 50 + t), {"stiffness": 40, "damping": 0.3}),
}


@pytest.mark.parametrize("kind", FREE)
def test_a_free_motion_a_cooling_and_an_emptying_need_no_input(folder, kind, capsys):
    header, outputs, course, truth = FREE[kind]
    t = np.arange(0.0, 40.0, 0.02)
    columns = np.atleast_2d(course(t))
    columns = columns + np.random.default_rng(3).normal(0, 1e-3, columns.shape) * np.ptp(columns[:1])
    rows = "\n".join(",".join(f"{v:.7g}" for v in row) for row in zip(t, *columns, strict=True))
    (folder / "a.csv").write_text(f"t,{header}\n{rows}\n")
    options = ["--outputs", outputs, "--inputs", ""] if outputs else []
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv", *options]) == 0
    assert (
        cli.main(["plant", "check", "p.yaml"])
        == cli.main(["plant", "check", "p.yaml", "--data", "a.csv"])
        == 0
    )
    plant = load("p.yaml")
    assert all(i.role == "ambient" for i in plant.inputs.values())
    assert [p.value for p in plant.parameters.values() if p.range is None] == [1]
    assert {n: plant.parameters[n].value for n in truth} == pytest.approx(truth, rel=0.1)
    assert cli.main(["refit", "--plant", "p.yaml", "a.csv", "--out", "o.yaml"]) == 0
    refitted = load("o.yaml").parameters
    assert {n: refitted[n].value for n in truth} == pytest.approx(truth, rel=0.01)


def test_levels_and_a_pump_become_tanks(folder):
    t, h, area, outlet = np.arange(0.0, 600.0, 1.0), [0.05], 0.02, 2e-4
    pump = np.where((t // 100).astype(int) % 2 == 0, 8e-5, 3e-5)
    for q in pump[:-1]:
        h.append(h[-1] + (q - outlet * h[-1] ** 0.5) / area)
    rows = "\n".join(f"{a:g},{6e4 * b:.4f},{100 * c:.4f}" for a, b, c in zip(t, pump, h, strict=True))
    (folder / "a.csv").write_text(f"t,Zufluss [l/min],Füllstand [cm]\n{rows}\n", encoding="utf-8")
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    values = {n.split("_")[0]: p.value for n, p in load("p.yaml").parameters.items()}
    assert values == {"area": pytest.approx(area, rel=0.05), "outlet": pytest.approx(outlet, rel=0.05)}


def test_names_say_what_heats_what(folder):
    t = np.arange(0.0, 900.0, 3.0)
    on = (t // 150).astype(int) % 2
    rows = "\n".join(
        f"{a:g},{b},{1 - b},{22 + 0.1 * a * b / (1 + a):.3f},{21 + 20 * (1 - np.exp(-a / 200)):.3f},{900 * b}"
        for a, b in zip(t, on, strict=True)
    )
    head = "t,extruder_pwm,heater_bed_pwm,extruder_temp,heater_bed_temp,sensor.heat_pump_power"
    (folder / "a.csv").write_text(f"{head}\n{rows}\n")
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv"]) == 0
    text = (folder / "p.yaml").read_text()
    assert text.count('value: "?", unit: W') == 2  # full power of each share of 0 to 1
    plant = loads(text.replace('"?"', "50"), "p.yaml")
    into = {f.name: f.target for f in plant.flows.values() if f.source is None}
    assert into["heat_extruder_pwm"] == "extruder" and into["heat_heater_bed_pwm"] == "heater_bed"
    assert "heat_pump_power" in plant.inputs and "W_heat_pump_power" in plant.parameters, "no flow of a pump"
    (folder / "p.yaml").unlink()
    assert cli.main(["plant", "new", "p.yaml", "--template", "hot-end", "--from-csv", "a.csv"]) == 0
    plant = load("p.yaml")
    duty = plant.inputs["duty"]
    assert (duty.column, duty.conversion.unit, plant.outputs["T_block"].column) == (
        "extruder_pwm",
        "1",
        "extruder_temp",
    )
    assert plant.parameters["fan"].value == 0, "no fan was recorded"


@pytest.mark.parametrize("named", [False, True])
def test_a_second_input_of_a_motion_is_not_dropped_in_silence(folder, named, capsys):
    t = np.arange(0.0, 20.0, 0.05)
    push, pull = np.where(t % 8 < 4, 2.0, 0.0), np.where(t % 5 < 2, 1.0, 0.0)
    speed = np.cumsum(push - pull - 0.5) * 0.05
    rows = "\n".join(f"{a:g},{b:g},{c:g},{d:.5f}" for a, b, c, d in zip(t, push, pull, speed, strict=True))
    (folder / "a.csv").write_text(f"t,F1 [N],F2 [N],speed [m/s]\n{rows}\n")
    options = ["--inputs", "F1,F2", "--outputs", "speed"] if named else []
    assert cli.main(["plant", "new", "p.yaml", "--from-csv", "a.csv", *options]) == (2 if named else 0)
    said = capsys.readouterr().err
    assert "'F2'" in said and "name one with --inputs" in said
    assert (folder / "p.yaml").exists() != named
