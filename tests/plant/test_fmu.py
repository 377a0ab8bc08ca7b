"""An FMU as the plant: the same simulation, slopes and places as the plant file; what it cannot be asked; errors."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import thermoctl as tc
from tests.plant.fmu_back import as_fmu
from thermoctl import cli
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.export.commands import write
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant, load, save
from thermoctl.plant.native.fmu import opened
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

HEATER = Path(__file__).parents[2] / "docs/examples/heater"
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="block" guid="{{1}}" numberOfEventIndicators="1">
  <ModelExchange modelIdentifier="block" providesDirectionalDerivative="{exact}"/>
  <ModelVariables>
    <ScalarVariable name="heater.P" valueReference="0" causality="input"><Real start="0" unit="W"/></ScalarVariable>
    <ScalarVariable name="air" valueReference="1" causality="input"><Real start="22" unit="degC"/></ScalarVariable>
    <ScalarVariable name="C" valueReference="2" causality="parameter" variability="fixed"><Real start="100" unit="J/K"/></ScalarVariable>
    <ScalarVariable name="G" valueReference="3" causality="parameter" variability="tunable"><Real start="0.2" unit="W/K"/></ScalarVariable>
    <ScalarVariable name="block.T" valueReference="4"><Real unit="degC"/></ScalarVariable>
    <ScalarVariable name="der(block.T)" valueReference="5"><Real derivative="5"/></ScalarVariable>
    <ScalarVariable name="reading" valueReference="6" causality="output"><Real unit="degC"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="7" dependencies="1 5"/></Outputs><Derivatives><Unknown index="6"/></Derivatives>
  </ModelStructure>
</fmiModelDescription>
"""
EXCHANGE = re.compile(rb"<ModelExchange[^>]*/>|<ModelExchange.*?</ModelExchange>", re.DOTALL)
NAMES = ("block.T", "heater.P", "air", "C", "G")


@pytest.fixture(scope="module")
def heater(tmp_path_factory):
    """The example's plant, the same by way of an FMU, and a recording."""
    plant = load(HEATER / "plant.yaml")
    (table,) = read_recordings(plant, [HEATER / "run_1.csv"])
    return plant, as_fmu(plant, table, tmp_path_factory.mktemp("fmu")), table


def without_exchange(fmu: Path, path: Path, instead: bytes = b"") -> Path:
    """Copy an FMU without its part of model exchange."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.infolist():
            new.writestr(
                item,
                EXCHANGE.sub(instead, old.read(item)) if item.filename[-4:] == ".xml" else old.read(item),
            )
    return path


def block(folder: Path, exact: bool = True, *options: str) -> Path:
    """Compile the FMU of fmu2_block.c."""
    path, library = folder / f"block{int(exact)}{len(options)}.fmu", folder / "block.so"
    source = Path(__file__).with_name("fmu2_block.c")
    subprocess.run(["cc", "-w", "-shared", "-fPIC", *options, "-o", library, source], check=True)
    with zipfile.ZipFile(path, "w") as fmu:
        fmu.writestr("modelDescription.xml", DESCRIPTION.format(exact=str(exact).lower()))
        fmu.write(library, "binaries/linux64/block.so")
    return path


SWITCHES = """<ScalarVariable name="on" valueReference="0" causality="input" variability="discrete"><Boolean start="true"/></ScalarVariable>
    <ScalarVariable name="stage" valueReference="1" causality="input" variability="discrete"><Integer start="1"/></ScalarVariable>
  </ModelVariables>"""


def switched(folder: Path, name: str, content: str = "binaries/linux64/block.so") -> Path:
    """The FMU of fmu2_block.c with a Boolean and an integer input; `content`: its library or its source."""
    path, made, source = folder / name, folder / "block.so", Path(__file__).with_name("fmu2_block.c")
    subprocess.run(["cc", "-w", "-shared", "-fPIC", "-o", made, source], check=True)
    text = DESCRIPTION.format(exact="true").replace('Indicators="1"', 'Indicators="0"')
    with zipfile.ZipFile(path, "w") as fmu:
        fmu.writestr(
            "modelDescription.xml",
            EXCHANGE.sub(b"<ModelExchange modelIdentifier='block'/>", text.encode()).replace(
                b"</ModelVariables>", SWITCHES.encode()
            ),
        )
        fmu.write(source if content.startswith("sources") else made, content)
    return path


def switched_run(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Its output, and the same by hand: the heater works while `on`, in the given stage."""
    t = np.arange(0.0, 60.0, 0.5)
    on, stage = (t < 40).astype(float), np.where(t < 20, 1.0, 2.0)
    columns = {"heater.P": np.full(len(t), 4.0), "air": np.full(len(t), 22.0), "on": on, "stage": stage}
    theirs = compile_plant(plant).simulate(Table("x", "x", t, columns)).y[:, 0]
    warm = [22.0]
    for k in range(len(t) - 1):
        rest, end = 4 * on[k] * stage[k] / 0.2, np.exp(-0.2 / 100 * 0.5)
        warm.append(22 + rest + (warm[-1] - 22 - rest) * end)
    return theirs, np.array(warm) + 0.01 * 4


def test_boolean_and_integer_inputs_are_driven(tmp_path):
    theirs, ours = switched_run(load(switched(tmp_path, "b.FMU")))
    assert np.max(np.abs(theirs - ours)) < 2e-3 < 0.1 * np.ptp(ours)


def test_an_fmu_of_sources_is_compiled(tmp_path):
    path = switched(tmp_path, "s.fmu", "sources/block.c")
    theirs, ours = switched_run(load(path))
    assert np.max(np.abs(theirs - ours)) < 2e-3
    other = switched(tmp_path, "w.fmu", "binaries/win64/block.dll")
    with pytest.raises(
        InputError, match=r"w.fmu: no library for this machine \(.*it has win64\) and no C sources"
    ):
        load(other)


def test_the_same_outputs_and_sensitivities(heater):
    plant, back, table = heater
    ours, theirs = (compile_plant(p).simulate(table, sensitivities=True) for p in (plant, back))
    assert np.max(np.abs(ours.y - theirs.y)) < 1e-9 * np.ptp(ours.y)
    order = [compile_plant(back).unknowns.index(q) for q in compile_plant(plant).unknowns]
    assert np.max(np.abs(ours.dy - theirs.dy[:, :, order])) < 1e-6 * np.max(np.abs(ours.dy))


def test_effects_at_inputs_outputs_and_states_but_not_inside(heater):
    plant, back, table = heater
    keys = []
    for p in (plant, back):
        rig = Rig(p, [compile_plant(p).excitation(table)], [table.columns])
        keys.append({c.key for c in candidates(rig, catalogue())})
    assert {e for e, _ in keys[0] - keys[1]} <= {
        "conductance_step", "heat_split", "temperature_dependent_conductance", "overflow",
    }  # fmt: skip
    assert keys[1] - keys[0] == {("missing_link", "one-two")}  # the description does not tell of the link
    rig = Rig(back, [compile_plant(back).excitation(table)], [table.columns])
    found = next(c for c in candidates(rig, catalogue()) if c.key == ("external_heat_source", "two"))
    longer = found.extend({"Q": 0.3, "T0": 500.0, "T1": 900.0})
    assert "two" in str(longer.flows["change_of_two"].rate)
    assert np.ptp(compile_plant(longer, ()).simulate(table).y - compile_plant(back, ()).simulate(table).y) > 1


def test_a_plant_with_an_fmu_is_saved_and_read_again_but_not_exported(heater, tmp_path):
    _, back, table = heater
    save(back, tmp_path / "plant.yaml")
    assert load(tmp_path / "plant.yaml").plain() == back.plain()
    with pytest.raises(InputError, match="calls an FMU cannot be exported"):
        write(back, "python", tmp_path / "plant.py", table)


def test_the_commands_and_python_take_an_fmu_with_its_map(heater, capsys):
    _, back, _ = heater
    fmu = Path(str(next(iter(back.flows.values())).rate).split('"')[1])
    mapped, run = str(fmu.with_name("map.yaml")), str(HEATER / "run_1.csv")
    assert cli.main(["plant", "check", str(fmu), "--map", mapped]) == 0
    assert cli.main(["simulate", "--plant", str(fmu), "--map", mapped, run]) == 0
    assert "temperature_2" in capsys.readouterr().out
    assert tc.simulate(tc.load_plant(fmu, map=mapped), run).rms["temperature_2"] > 1


@pytest.mark.parametrize("exact", [True, False])
def test_a_strict_fmu_with_a_relation_and_a_fixed_parameter(tmp_path, exact):
    """Values and slopes on both sides of the relation's switch, whatever was asked before."""
    fmu = opened(str(block(tmp_path, exact)))
    for T, P, air, C, G in [
        (30, 5, 22, 100, 0.2),
        (70, 5, 22, 100, 0.2),
        (30, 5, 21, 80, 0.3),
        (50, 9, 20, 80, 0.2),
    ]:
        at = [0.0, T, P, air, C, G]
        on = T < 60
        rate = (on * P - G * (T - air)) / C
        assert fmu.evaluate("der(block.T)", NAMES, at) == pytest.approx(rate, rel=1e-12)
        slopes = {"block.T": -G / C, "heater.P": on / C, "air": G / C, "C": -rate / C, "G": -(T - air) / C}
        for name, slope in slopes.items():
            assert fmu.evaluate("der(block.T)", NAMES, at, name) == pytest.approx(slope, rel=1e-6, abs=1e-12)
    assert fmu.evaluate(
        "reading", ("block.T", "heater.P"), [0.0, np.array([20.0, 30.0]), 5.0]
    ) == pytest.approx([20.05, 30.05])


def test_directional_derivatives_are_used_where_given(tmp_path):
    wrong = opened(str(block(tmp_path, True, "-DNOMINAL_SLOPE(g,c)=(-7.0)")))
    assert wrong.evaluate("der(block.T)", NAMES, [0.0, 30, 5, 22, 100, 0.2], "block.T") == -7


def test_a_map_gives_what_the_description_lacks(tmp_path):
    path = block(tmp_path)
    mapped = tmp_path / "map.yaml"
    mapped.write_text(
        "inputs: {heater.P: {column: P, between_samples: hold}, air: {constant: 20}}\n"
        "states: {block.T: {storage: C, initial: first(reading)}}\nparameters: {G: {range: [0.1, 0.4]}}\n"
    )
    plant = load(path, mapped)
    assert list(plant.inputs) == ["heater_P"] and list(plant.parameters) == ["C", "G"]
    assert plant.parameters["C"].range is None and plant.parameters["G"].range == (0.1, 0.4)
    t = np.arange(0.0, 400.0)
    y = (
        compile_plant(plant, ())
        .simulate(Table("r", "r.csv", t, {"P": 0 * t + 4, "reading": 0 * t + 25}))
        .y[:, 0]
    )
    assert y == pytest.approx(0.04 + 40 - 15 * np.exp(-0.2 / 100 * t), abs=1e-4)


@pytest.mark.parametrize(
    "text, says",
    [
        ("state: {}", r"map.yaml:1:\d+: 'state' is no section of a map \(did you mean 'states'\?\)"),
        ("states: {block: {}}", r"map.yaml:1:\d+: .*no state 'block' \(did you mean 'block.T'\?\)"),
        ("states: {block.T: {storage: Q}}", r"map.yaml:1:\d+: storage of 'block_T': 'Q' is not known"),
        ("outputs: {reading: {nois: 1}}", r"map.yaml:1:\d+: .*'nois'"),
        ("parameters: {C: 20}", r"map.yaml:1:17: C: keys and values such as .range: .* expected, found 20"),
        ("inputs: {air: [1, 2]}", r"map.yaml:1:15: air: keys and values such as .* expected, found a list"),
        (
            "inputs: {air: {constant: x}}",
            r"map.yaml:1:26: constant of 'air': a number was expected, found 'x'",
        ),
    ],
)
def test_a_wrong_map_is_refused_with_its_line(tmp_path, text, says):
    path = block(tmp_path)
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(InputError, match=says):
        load(path, tmp_path / "map.yaml")


@pytest.mark.parametrize(
    "old, new",
    [
        (rb' derivative="\d+"', b""),
        (rb' max="[^"]*"', b' max="much"'),
        (rb'valueReference="', b'valueReference="9'),
    ],
)
def test_a_damaged_description_ends_in_one_line(tmp_path, old, new):
    path = tmp_path / "damaged.fmu"
    write(load(HEATER / "plant.yaml"), "fmu", tmp_path / "good.fmu")
    with zipfile.ZipFile(tmp_path / "good.fmu") as good, zipfile.ZipFile(path, "w") as packed:
        for item in good.infolist():
            data = good.read(item)
            packed.writestr(item, re.sub(old, new, data) if item.filename.endswith(".xml") else data)
    with pytest.raises(InputError, match=r"damaged.fmu: no usable FMU \(\w+: .*\); export it anew"):
        load(path)


@pytest.mark.parametrize("part", [0.003, 0.05, 0.3, 0.6, 0.9, 0.999])
def test_a_library_that_is_cut_short_ends_in_one_line(tmp_path, part):
    """Loading it ended the program by SIGBUS, though the archive's own checksums fitted."""
    whole, cut = block(tmp_path), tmp_path / "cut.fmu"
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(cut, "w") as new:
        for item in old.infolist():
            data = old.read(item)
            new.writestr(item, data[: int(part * len(data))] if item.filename.endswith(".so") else data)
    code = f"from thermoctl.plant.native.fmu import opened; opened({str(cut)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "cut.fmu: block.so in it is cut short; export it anew" in done.stderr.splitlines()[-1], done


def test_what_is_no_usable_fmu_is_said(heater, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path / "none.fmu")
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(InputError, match="no usable FMU"):
        load(tmp_path / "text.fmu")
    with pytest.raises(InputError, match="goes with an FMU"):
        load(HEATER / "plant.yaml", tmp_path / "map.yaml")
    path = block(tmp_path)
    for instead, words in (
        (b"", "was expected; export"),
        (b"<CoSimulation modelIdentifier='block'/>", "found one of co-simulation only"),
    ):
        with pytest.raises(InputError, match=words):
            load(without_exchange(path, tmp_path / "other.fmu", instead))
    with pytest.raises(InputError, match="no state, input or parameter 'Q'"):
        opened(str(path)).argument("Q")
    with pytest.raises(InputError, match="no derivative and no output 'T'"):
        opened(str(path)).result("T")


PYTHON = '''
from pythonfmu3 import Fmi3Causality as Is, Fmi3Initial, Fmi3Slave, Fmi3Variability as Changes, Float64, ModelExchange

class Block(Fmi3Slave, ModelExchange):
    def __init__(self, **given):
        super().__init__(**given)
        self.time, self.T, self.slope, self.power, self.C = 0.0, 22.0, 0.0, 0.0, 100.0
        always = {"variability": Changes.continuous}
        self.register_variable(Float64("time", causality=Is.independent, **always))
        self.register_variable(Float64("power", causality=Is.input, start=0.0, **always))
        self.register_variable(Float64("C", causality=Is.parameter, variability=Changes.tunable, start=100.0))
        self.register_variable(Float64("T", causality=Is.output, start=22.0, initial=Fmi3Initial.exact, **always))
        self.register_variable(Float64("slope", causality=Is.local, derivative=3, **always))

    def get_continuous_state_derivatives(self):
        self.slope = (self.power - 0.2 * (self.T - 22)) / self.C
        return [self.slope]
'''  # fmt: skip


def test_an_fmu_of_fmi_3_by_pythonfmu3(tmp_path):
    """The output is the state itself; the plant gives it another name."""
    builder = pytest.importorskip("pythonfmu3.builder")
    (tmp_path / "block.py").write_text(PYTHON)
    builder.FmuBuilder.build_FMU(tmp_path / "block.py", dest=tmp_path)
    (tmp_path / "map.yaml").write_text(
        "inputs: {power: {between_samples: hold}}\nparameters: {C: {range: [50, 200]}}"
    )
    plant = load(tmp_path / "Block.fmu", tmp_path / "map.yaml")
    t = np.arange(0.0, 200.0, 5.0)
    run = compile_plant(plant).simulate(Table("r", "r.csv", t, {"power": 0 * t + 4}), sensitivities=True)
    heated = 20 * (1 - np.exp(-0.2 / 100 * t))
    assert run.y[:, 0] == pytest.approx(22 + heated, abs=1e-4)
    assert run.dy[:, 0, 0] == pytest.approx(-4 * t / 100**2 * np.exp(-0.2 / 100 * t), abs=1e-5)
