"""Exported plants give the outputs of our own simulation within 1e-6 of each output's range."""

import dataclasses
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

from tests.export.plants import DELAYED, FRICTION, plants, recording
from thermoctl import cli
from thermoctl.export.commands import write
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant import load, loads, save
from thermoctl.plant.simulation.equations import Equations, argument
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import write_table

ALL = plants()
TOLERANCE = 1e-6  # of each output's range


@pytest.fixture(params=ALL)
def case(request):
    """A plant, a recording, the inputs (N, ni) and our outputs (N, ny), integrated a hundred times finer than by default."""
    plant, dt = ALL[request.param]
    table = recording(plant, dt=dt)
    model = compile_plant(plant, ())
    excitation = model.prepare(model.excitation(table))
    y = model.run(excitation, rtol=1e-9).y
    return plant, table, excitation.t, excitation.u[:, : len(plant.inputs)], y


def near(found, y):
    assert np.all(np.max(np.abs(found - y), axis=0) < TOLERANCE * np.ptp(y, axis=0))


def test_python(case, tmp_path):
    plant, table, t, u, y = case
    write(plant, "python", tmp_path / "plant.py", table)
    module = {}
    exec(compile((tmp_path / "plant.py").read_text(), "plant.py", "exec"), module)
    found = module["simulate"](t, dict(zip(plant.inputs, u.T, strict=True)))
    near(np.array([found[o] for o in plant.outputs]).T, y)


def test_c(case, tmp_path):
    plant, table, t, u, y = case
    write(plant, "c", tmp_path / "plant.c", table)
    command = ["cc", "-std=c99", "-O2", "-DMAIN", "plant.c", "-lm", "-o", "plant"]
    subprocess.run(command, cwd=tmp_path, check=True)
    rows = "\n".join(",".join(map(repr, map(float, row))) for row in np.column_stack([t, u]))
    text = f"t,{','.join(plant.inputs)}\n{rows}\n"
    out = subprocess.run([tmp_path / "plant"], input=text, capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[0] == f"t,{','.join(plant.outputs)}"
    near(np.array([[float(q) for q in line.split(",")] for line in out.splitlines()[1:]])[:, 1:], y)


def fmu_of(plant, table, path):
    write(plant, "fmu", path, table)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from fmpy import extract, read_model_description
        from fmpy.fmi2 import FMU2Slave
        from fmpy.validation import validate_fmu

        assert validate_fmu(str(path)) == []
        description = read_model_description(str(path))
        slave = FMU2Slave(
            guid=description.guid,
            unzipDirectory=extract(str(path), unzipdir=str(path.with_suffix(""))),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="tested",
        )
    return description, slave


def test_fmu_in_co_simulation(case, tmp_path):
    plant, table, t, u, y = case
    description, fmu = fmu_of(plant, table, tmp_path / "plant.fmu")
    refs = {v.name: v.valueReference for v in description.modelVariables}
    inputs, outputs = [refs[i] for i in plant.inputs], [refs[o] for o in plant.outputs]
    linear = [k for k, i in enumerate(plant.inputs.values()) if i.linear]
    fmu.instantiate()
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.setReal(inputs, u[0])
    fmu.exitInitializationMode()
    found = [fmu.getReal(outputs)]
    from ctypes import c_double, c_int, c_uint32

    for n in range(len(t) - 1):
        h = t[n + 1] - t[n]
        k = len(linear)
        slopes = (c_double * k)(*((u[n + 1, linear] - u[n, linear]) / h))
        references = (c_uint32 * k)(*[inputs[j] for j in linear])
        fmu.fmi2SetRealInputDerivatives(fmu.component, references, k, (c_int * k)(*([1] * k)), slopes)
        fmu.doStep(currentCommunicationPoint=t[n], communicationStepSize=h)
        fmu.setReal(inputs, u[n + 1])
        found.append(fmu.getReal(outputs))
    fmu.terminate()
    fmu.freeInstance()
    near(np.array(found), y)


@pytest.mark.parametrize("name", ["actuator", "tank", "extended", "tabled"])
def test_fmu_in_model_exchange_by_another_solver(name, tmp_path):
    """FMPy's CVode integrates it. FMPy sets inputs between steps only, so inputs of straight lines are constant here."""
    from fmpy import simulate_fmu

    plant, _ = ALL[name]
    table = recording(plant, dt=1.0)
    constant = {i.column: np.full(len(table.t), 21.5) for i in plant.inputs.values() if i.linear}
    table = dataclasses.replace(
        table, t=np.arange(len(table.t), dtype=float), columns=table.columns | constant
    )
    model = compile_plant(plant, ())
    excitation = model.prepare(model.excitation(table))
    y = model.run(excitation, rtol=1e-9).y
    write(plant, "fmu", tmp_path / "plant.fmu", table)
    signals = np.zeros(len(table.t), dtype=[("time", float), *((i, float) for i in plant.inputs)])
    signals["time"] = table.t
    for j, i in enumerate(plant.inputs):
        signals[i] = excitation.u[:, j]
    found = simulate_fmu(
        str(tmp_path / "plant.fmu"),
        fmi_type="ModelExchange",
        stop_time=table.t[-1],
        output_interval=1.0,
        relative_tolerance=1e-10,
        input=signals,
        output=list(plant.outputs),
        record_events=False,
    )
    near(np.array([found[o] for o in plant.outputs]).T, y)


def test_a_jump_of_time_is_an_event_of_the_fmu(tmp_path):
    """Without a recording the jump is not smoothed; the master stops at it."""
    from fmpy.fmi2 import FMU2Model

    plant, _ = ALL["tabled"]
    description, slave = fmu_of(plant, None, tmp_path / "plant.fmu")
    assert slave.modelIdentifier == "plant"
    fmu = FMU2Model(
        guid=description.guid,
        unzipDirectory=str(tmp_path / "plant"),
        modelIdentifier="plant",
        instanceName="tested",
    )
    refs = {v.name: v.valueReference for v in description.modelVariables}
    fmu.instantiate()
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.setReal([refs["heat"], refs["air"]], [1.0, 20.0])
    fmu.exitInitializationMode()
    *_, defined, at = fmu.newDiscreteStates()
    assert defined and at == 133.0
    fmu.enterContinuousTimeMode()
    fmu.setContinuousStates((__import__("ctypes").c_double * 1)(30.0), 1)
    before = fmu.getReal([refs["der(block)"]])[0]
    fmu.setTime(133.0)
    assert fmu.getReal([refs["der(block)"]])[0] == before, "it jumps at the event, not within a step"
    fmu.enterEventMode()
    *_, defined, _ = fmu.newDiscreteStates()
    assert not defined and fmu.getReal([refs["der(block)"]])[0] < before
    fmu.freeInstance()


def test_modelica_has_the_same_equations(case, tmp_path):
    """Each equation of the model, read back as arithmetic, has our value at random states."""
    plant, table, _, u, _ = case
    write(plant, "modelica", tmp_path / "Plant.mo", table)
    text = (tmp_path / "Plant.mo").read_text()
    declared = dict(re.findall(r"parameter Real (\w+)(?:\([^)]*\))? = ([^; ]+)", text))
    equations = re.split(r"\nequation\n", text)[1].rsplit("end Plant;", 1)[0]
    equations = re.sub(
        r"\(if ((?:[^()]|\([^()]*\))+) then 1\.0 else 0\.0\)", r"(1.0 if \1 else 0.0)", equations
    )
    rng = np.random.default_rng(1)
    values = {k: float(v) for k, v in declared.items()} | {"time": 57.3}
    values |= dict(zip(plant.inputs, map(float, u[len(u) // 2]), strict=True))
    states = {n: float(rng.uniform(0.1, 30)) for n in plant.nodes}
    known = {**values, **states, "t": 57.3}
    known |= {p: values[p] if p in values else values[f"{p}_"] for p in plant.parameters}
    values |= states | {f"{n}_": v for n, v in {**states, **known}.items()}

    def table_of(x, xs, ys):
        return float(np.interp(x, sorted(xs), [y for _, y in sorted(zip(xs, ys, strict=True))]))

    scope = {f: getattr(np, f) for f in ("abs", "sqrt", "exp", "log", "sin", "cos", "tanh")}
    scope |= {"min": min, "max": max, "delay": lambda value, seconds: value, "straightLines": table_of}
    widths = {id(z): w for z, w in zip_widths(plant, table)}

    def ours(e):
        e = ex.substitute(e, lambda q: q.args[0] if q.op == "delay" else None)
        return float(ex.evaluate(e, known, width=lambda jump: widths.get(id(argument(jump)), 0.0)))

    for line in filter(None, map(str.strip, equations.split(";\n"))):
        left, right = line.split(" = ", 1)
        python = (
            re.sub(r"\blambda\b", "lambda_", right).replace("^", "**").replace("{", "(").replace("}", ")")
        )
        found = float(eval(python, scope, values))
        name = left.removesuffix("_")
        if "der(" in left:
            node = re.search(r"der\((\w+?)_?\)", left)[1]
            expected = sum(
                ours(f.rate) * ((f.target == node) - (f.source == node)) for f in plant.flows.values()
            )
            storage = float(eval(left.split(" * der(")[0].replace("{", "(").replace("}", ")"), scope, values))
            assert storage == pytest.approx(ours(plant.nodes[node].storage), rel=1e-12)
        elif name in plant.outputs:
            expected = ours(plant.outputs[name].value)
        else:
            expected = ours(plant.flows[name.removeprefix("flow_") if name not in plant.flows else name].rate)
            values[left] = expected
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12), line


def zip_widths(plant, table):
    from thermoctl.export.values import values

    equations = Equations(plant)
    return [(z, w) for (z, _), w in zip(equations.jumps, values(plant, equations, table).width, strict=True)]


def test_a_plant_that_needs_a_recording_says_so(tmp_path):
    with pytest.raises(
        InputError, match=r"reads first\(position\), an output: give a recording \(--data REC\)"
    ):
        write(loads(FRICTION), "c", tmp_path / "plant.c")


@pytest.mark.parametrize("to", ["fmu", "modelica", "python", "c"])
def test_the_command(to, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plant, dt = ALL["extended"]
    save(plant, "two.yaml")
    write_table("run.csv", recording(load("two.yaml"), dt=dt))
    assert cli.main(["plant", "export", "two.yaml", "--to", to, "--data", "run.csv"]) == 0
    (name,) = capsys.readouterr().out.split()
    assert (tmp_path / name).stat().st_size > 1000
    assert cli.main(["plant", "export", "two.yaml", "--to", to, "--out", "two.txt"]) == 2
    assert "a file that ends in" in capsys.readouterr().err


def test_an_input_that_is_logged_late_needs_its_recording(tmp_path):
    """A program that is given one row after the other does not know the next: only the Python file has all rows."""
    ahead = {"delay(heat, transport)": "delay(heat, -transport)", "delay(air, slow)": "delay(air, -slow)"}
    text = DELAYED
    for late, early in ahead.items():
        text = text.replace(late, early)
    plant = loads(text)
    table = recording(plant)
    model = compile_plant(plant, ())
    excitation = model.prepare(model.excitation(table))
    write(plant, "python", tmp_path / "plant.py", table)
    module = {}
    exec(compile((tmp_path / "plant.py").read_text(), "plant.py", "exec"), module)
    found = module["simulate"](excitation.t, dict(zip(plant.inputs, excitation.u[:, :2].T, strict=True)))
    near(np.array([found[o] for o in plant.outputs]).T, model.run(excitation, rtol=1e-9).y)
    for to in ("c", "fmu", "modelica"):
        with pytest.raises(InputError, match="7.3 s ahead of its time.*--to python"):
            write(plant, to, tmp_path / "plant", table)
        assert not (tmp_path / "plant").exists()


def test_the_python_file_needs_nothing_of_ours(tmp_path):
    plant, dt = ALL["hot-end"]
    write(plant, "python", tmp_path / "hot_end.py", recording(plant, dt=dt))
    code = "import sys, hot_end; assert not any(m.startswith('thermoctl') for m in sys.modules); print(hot_end.INPUTS)"
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == str(list(plant.inputs))
