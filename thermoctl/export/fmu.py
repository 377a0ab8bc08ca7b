"""A plant as an FMU of FMI 2.0: co-simulation, and model exchange where it has no delay.

The FMU holds its C source, and the binary that this machine's compiler makes of it."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

from thermoctl import __version__
from thermoctl.export.c import core, time_jumps
from thermoctl.export.values import Values, first_outputs
from thermoctl.files.safe_file import whole_file
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.native.build import compiler, run_compiler
from thermoctl.plant.simulation.equations import Equations
from thermoctl.units import conversion, dimension

_PLATFORM = {"linux": ("linux64", ".so"), "darwin": ("darwin64", ".dylib")}
_BASES = {"kg": "kg", "m": "m", "s": "s", "A": "A", "K": "K", "mol": "mol", "cd": "cd"}


def write_fmu(plant: Plant, numbers: Values, path: Path, start: dict[str, float] | None = None) -> None:
    """Write the FMU; `start`: values of the inputs before they are set.

    Raises InputError where no C compiler is found or the compiler fails."""
    e = Equations(plant)
    identifier = re.sub(r"\W", "_", path.stem) if path.stem[:1].isalpha() else "plant"
    begin = [float((start or {}).get(i, 0.0)) for i in plant.inputs]
    body = core(plant, e, numbers) + time_jumps(e)
    body += f"static const double START[] = {{{', '.join(map(repr, begin)) or '0'}}};\n"
    guid = f"{{{uuid.uuid5(uuid.NAMESPACE_OID, body)}}}"
    source = f'{body}#define GUID "{guid}"\n' + Path(__file__).with_name("fmi2.h").read_text()
    folder, suffix = _PLATFORM.get(sys.platform, ("linux64", ".so"))
    with tempfile.TemporaryDirectory() as work:
        code, library = Path(work) / f"{identifier}.c", Path(work) / f"{identifier}{suffix}"
        code.write_text(source)
        command = [*compiler(), "-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-w"]
        run_compiler([*command, "-o", str(library), str(code), "-lm"], "the FMU", work)
        packed = Path(work) / "packed.fmu"
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as fmu:
            fmu.writestr("modelDescription.xml", _description(plant, e, numbers, identifier, guid, begin))
            fmu.write(code, f"sources/{identifier}.c")
            fmu.write(library, f"binaries/{folder}/{identifier}{suffix}")
        with whole_file(path) as part:
            shutil.copyfile(packed, part)


def _description(
    plant: Plant, e: Equations, numbers: Values, identifier: str, guid: str, begin: list[float]
) -> str:
    variables = list(_variables(plant, e, numbers, begin))
    units = sorted(
        {i.unit for i in [*plant.readings(), *plant.parameters.values(), *plant.nodes.values()] if i.unit}
    )
    states = len(e.states)
    first_state = (
        1 + len(plant.inputs) + len(e.parameters) + len(e.jumps) + len(first_outputs(plant)) + states
    )
    derivatives = range(first_state + states, first_state + 2 * states)
    outputs = range(first_state + 2 * states, first_state + 2 * states + len(e.outputs))
    sources = f'<SourceFiles><File name="{identifier}.c"/></SourceFiles>'
    exchange = f'  <ModelExchange modelIdentifier="{identifier}">{sources}</ModelExchange>\n'
    simulation = (
        f'  <CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="true" '
        f'canInterpolateInputs="true">{sources}</CoSimulation>\n'
    )
    unknown = {
        "Outputs": outputs,
        "Derivatives": derivatives,
        "InitialUnknowns": [*range(first_state, first_state + states), *derivatives, *outputs],
    }
    reads = dict(zip((*derivatives, *outputs), _dependencies(plant, e, first_state), strict=True))
    structure = "".join(
        f"    <{k}>\n"
        + "".join(
            f'      <Unknown index="{i}"{reads.get(i, "") if k != "InitialUnknowns" else ""}/>\n' for i in v
        )
        + f"    </{k}>\n"
        for k, v in unknown.items()
        if v
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(plant.title or identifier)} guid="{guid}" '
        f'generationTool="thermoctl {__version__}" variableNamingConvention="flat" numberOfEventIndicators="0">\n'
        + ("" if e.input_delays or e.output_delays else exchange)
        + simulation
        + ("  <UnitDefinitions>\n" + "".join(map(_unit, units)) + "  </UnitDefinitions>\n" if units else "")
        + "  <ModelVariables>\n"
        + "\n".join(variables)
        + f"\n  </ModelVariables>\n  <ModelStructure>\n{structure}  </ModelStructure>\n</fmiModelDescription>\n"
    )


def _dependencies(plant: Plant, e: Equations, first_state: int) -> list[str]:
    """Return the attribute that names the inputs and states which each derivative and each output reads.

    A plant with delays gets none: a delayed value is a state of the FMU's own."""
    if e.input_delays or e.output_delays:
        return [""] * (len(e.states) + len(e.outputs))
    index = {i: 1 + k for k, i in enumerate(plant.inputs)}
    index |= {n: first_state + k for k, n in enumerate(e.states)}
    read = [sorted(index[n] for n in ex.names(q) & index.keys()) for q in (*e.slopes, *e.values)]
    return [f' dependencies="{" ".join(map(str, r))}"' for r in read]


def _variables(plant: Plant, e: Equations, numbers: Values, begin: list[float]) -> Iterator[str]:
    """Yield every variable, in the order of the value references in fmi2.h."""
    count = iter(range(10**6))

    def variable(
        name: str, kind: str, unit: str | None = None, start: float | None = None, **more: str
    ) -> str:
        """Return a variable with the next value reference; `more`: attributes of Real, and `description`."""
        real = "".join(f" {k}={quoteattr(v)}" for k, v in more.items() if k != "description")
        real += f" unit={quoteattr(unit)}" if unit else ""
        real += f' start="{start!r}"' if start is not None else ""
        description = f" description={quoteattr(more['description'])}" if "description" in more else ""
        return f'    <ScalarVariable name={quoteattr(name)} valueReference="{next(count)}"{description} {kind}><Real{real}/></ScalarVariable>'

    for i, value in zip(plant.inputs.values(), begin, strict=True):
        change = "continuous" if i.linear else "discrete"
        yield variable(i.name, f'causality="input" variability="{change}"', i.unit, value)
    tunable = 'causality="parameter" variability="tunable" initial="exact"'
    for p in plant.parameters.values():
        ends = dict(zip(("min", "max"), map(repr, p.range), strict=True)) if p.range else {}
        yield variable(p.name, tunable, p.unit, numbers.parameters[p.name], **ends)
    for k, ((jump, _), width) in enumerate(zip(e.jumps, numbers.width, strict=True)):
        text = f"half width over which the jump at {jump} = 0 is smoothed; 0: none"
        yield variable(f"width_{k}", tunable, None, width, description=text)
    fixed = 'causality="parameter" variability="fixed" initial="exact"'
    for o in first_outputs(plant):
        description = f"first recorded value of {o}"
        yield variable(f"first_{o}", fixed, plant.outputs[o].unit, numbers.first[o], description=description)
    for n in plant.nodes.values():
        yield variable(
            f"shift_{n.name}", fixed, None, 0.0, description=f"added to the initial value of {n.name}"
        )
    calculated = 'causality="local" variability="continuous" initial="calculated"'
    for n in plant.nodes.values():
        yield variable(n.name, calculated, n.unit)
    first = (
        1 + len(plant.inputs) + len(e.parameters) + len(e.jumps) + len(first_outputs(plant)) + len(e.states)
    )
    for k, n in enumerate(plant.nodes.values()):
        yield variable(f"der({n.name})", calculated, None, derivative=str(first + k))
    for out in plant.outputs.values():
        name = out.name if out.name not in plant.nodes else f"{out.name}_reading"
        yield variable(name, 'causality="output" variability="continuous" initial="calculated"', out.unit)


def _unit(unit: str) -> str:
    """Return one unit, with factor and offset to SI where its dimension has integer exponents."""
    powers = dimension(unit)
    if any(b not in _BASES or p.denominator != 1 for b, p in powers):
        return f"    <Unit name={quoteattr(unit)}/>\n"
    exponents = "".join(f' {_BASES[b]}="{p}"' for b, p in powers)
    base = "*".join(f"{b}**{p}" for b, p in powers) or "1"
    factor, offset = conversion(unit, base)
    more = f' factor="{factor!r}"' if factor != 1 else ""
    more += f' offset="{offset!r}"' if offset else ""
    return f"    <Unit name={quoteattr(unit)}><BaseUnit{exponents}{more}/></Unit>\n"
