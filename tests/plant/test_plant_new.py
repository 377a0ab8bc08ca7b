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
from thermoctl.plant import load
from thermoctl.plant.new import TEMPLATES
from thermoctl.plant.simulate import compile_plant
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
    """`make stranger` prints the commands, the two edits and their times."""
    stranger(folder / "log.csv")
    times = []

    def command(line: str) -> None:
        begin = time.monotonic()
        assert cli.main(line.split()) == 0
        times.append(f"{time.monotonic() - begin:6.1f} s  thermoctl {line}")

    command("plant new rig.yaml --from-csv log.csv")
    printed = capsys.readouterr()
    assert "time taken from column 'Zeit'" in printed.err and "decimal comma" in printed.err
    assert "it heats 'Block'" in printed.out and "touch" in printed.out
    plant = load("rig.yaml")
    assert list(plant.inputs) == ["P_Heizung", "T_Luft"] and list(plant.nodes) == ["Block", "K_hler"]
    assert 0.01 < plant.outputs["T_Block"].noise_sd < 0.1
    text = (folder / "rig.yaml").read_text()
    for name, value in (("C_Block", 90), ("C_K_hler", 150)):  # two edits, from the parts' data sheets
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
    from thermoctl.shipped import shipped

    assert {p.stem for p in shipped("config/plants/templates").glob("*.yaml")} == set(TEMPLATES)
    with pytest.raises(SystemExit):
        cli.main(["plant", "new", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert all(t in printed for t in TEMPLATES)


@pytest.mark.parametrize(
    "args, text, says",
    [
        (
            ["--from-csv", "a.csv", "--template", "block"],
            "",
            "either --from-csv RECORDING or --template NAME",
        ),
        (["--template", "blok"], "", "did you mean 'block'"),
        (["--from-csv", "a.csv"], "t,x [m]\n0,1\n1,2\n", "no temperature"),
        (["--from-csv", "a.csv"], "t,T [degC]\n0,1\n1,2\n", "no power"),
        (
            ["--from-csv", "a.csv", "--outputs", "P"],
            "t,P [W],T [degC]\n0,1,2\n1,2,2\n",
            "'P' is no temperature",
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
