"""The files of an FMU for co-simulation (FMI 2.0): its C source, and `modelDescription.xml`.

The source: the model's equations as functions, the simulator's step (`c/plant.c`: leapfrog with sharp friction, as
`simulate/plant.py` has it, so that with equal steps the trajectory is the simulator's but for rounding),
the functions of FMI (`c/fmu_interface.c`). A step that fails leaves the state unchanged, is logged, and is an error. An
instance is one block of memory, so its state is stored and restored as bytes.

Variables are named as a log's columns: `tau_J` is an input, `q_J`, `v_J`, `x_tool` and so on are outputs; `q0_J` and `v0_J` are
the initial state; parameters keep their names. Reference: FMI for Model Exchange and Co-Simulation 2.0.4, 2.2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from tau_dyn.codegen.c_writer import escape_comment_line, fill_template, list_numbers
from tau_dyn.codegen.plant_equations import Equations, yield_plant_parts
from tau_dyn.version import __version__


def write_fmu_source(equations: Equations, guid: str, about: str) -> str:
    """Return the source, which includes headers of the C library only; `about` is a paragraph that describes the FMU."""
    return "\n\n".join(_yield_parts(equations, guid, about)) + "\n"


def _yield_parts(equations: Equations, guid: str, about: str) -> Iterator[str]:
    model, loops = equations.model, equations.loops
    yield f"/* {escape_comment_line(about)} FMI 2.0 for co-simulation; C99. */\n" + "\n".join(
        f"#include <{name}.h>" for name in ("math", "stddef", "stdlib", "string")
    )
    sizes = {
        "NA": model.robot.na,
        "NP": len(loops.passive) if loops is not None else 0,
        "NTHETA": max(1, len(equations.parameters)),
        "NTOOL": 3 if equations.tool else 0,
    }
    yield f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};"
    yield "\n".join(_yield_macros(equations, guid))
    names, values = model.parameters.names, model.parameters.values
    places = list(equations.parameters)
    yield "\n".join(
        (
            f"/* Parameters: {escape_comment_line(', '.join(names[k] for k in places)) or 'none'}. */",
            f"static const double nominal[NTHETA] = {{{list_numbers(values[places] if places else np.zeros(1))}}};",
            f"static const double home_position[NA] = {{{list_numbers(model.robot.home)}}};",
        )
    )
    yield fill_template("checks")
    yield from yield_plant_parts(equations, ("tool",))
    yield fill_template("fmu_interface")


def _yield_macros(equations: Equations, guid: str) -> Iterator[str]:
    yield f'#define GUID "{guid}"'
    yield f"#define START(s) {'plant_start((s)->start)' if equations.loops is not None else '((void)0)'}"
    yield f"#define TOOL(s, x) {'tool((s)->q, PASSIVE(s) x)' if equations.tool else '0'}"


_BASE = {
    "m": {"m": 1}, "kg": {"kg": 1}, "s": {"s": 1}, "rad": {"rad": 1}, "N": {"kg": 1, "m": 1, "s": -2}, "K": {"K": 1},
    "A": {"A": 1}, "V": {"kg": 1, "m": 2, "s": -3, "A": -1}, "W": {"kg": 1, "m": 2, "s": -3}, "J": {"kg": 1, "m": 2, "s": -2},
}  # fmt: skip


class Variable(NamedTuple):
    """One variable; its place in the list is its value reference."""

    name: str
    causality: str
    variability: str
    unit: str
    start: float | None
    what: str


def build_variables(equations: Equations) -> tuple[Variable, ...]:
    """Return an FMU's variables in the order of their value references."""
    return tuple(_variables(equations))


def _variables(equations: Equations) -> Iterator[Variable]:
    model, robot = equations.model, equations.model.robot
    joints = list(zip(robot.actuated, robot.position_units, robot.force_units, robot.home, strict=True))
    for joint, _, force, _ in joints:
        yield Variable(f"tau_{joint}", "input", "continuous", force, 0.0, "force of the actuator at the joint")
    for joint, place, _, _ in joints:
        yield Variable(f"q_{joint}", "output", "continuous", place, None, "position")
    for joint, place, _, _ in joints:
        yield Variable(f"v_{joint}", "output", "continuous", f"{place}/s", None, "velocity")
    if equations.tool is not None:
        for axis in "xyz":
            yield Variable(f"{axis}_tool", "output", "continuous", "m", None, "tool position in the base frame")
    every = list(model.parameters)
    for k in equations.parameters:
        p = every[k]
        error = f"standard error {p.stderr:.2g}" if p.stderr is not None else "nominal"
        yield Variable(p.name, "parameter", "tunable", p.unit, p.value, error)
    if not equations.parameters:
        yield Variable("none", "parameter", "tunable", "", 0.0, "this model has no parameters")
    for joint, place, _, home in joints:
        yield Variable(f"q0_{joint}", "parameter", "fixed", place, float(home), "position at the start")
    for joint, place, _, _ in joints:
        yield Variable(f"v0_{joint}", "parameter", "fixed", f"{place}/s", 0.0, "velocity at the start")
    yield Variable("step", "parameter", "fixed", "s", 1e-3, "longest step of the plant within a communication step")


def format_identifier(name: str) -> str:
    """Return a name that C and file systems take."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)[:60]
    return text if re.match(r"[A-Za-z]", text) else f"robot_{text}"


def format_description(equations: Equations, guid: str, about: str) -> str:
    """Return the file's text; `about` is a paragraph that describes the FMU."""
    model = equations.model
    identifier, variables = format_identifier(model.robot.name), build_variables(equations)
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model.robot.name,
        guid=guid,
        description=about,
        generationTool=f"tau_dyn {__version__}",
        variableNamingConvention="flat",
    )
    simulation = SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        canHandleVariableCommunicationStepSize="true",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    SubElement(SubElement(simulation, "SourceFiles"), "File", name="fmu.c")
    _units(root, variables)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError")
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", stepSize="0.001")
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        _write(listed, reference, variable)
    _structure(root, variables)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _units(root: Element, variables: tuple[Variable, ...]) -> None:
    units = SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(v.unit for v in variables if v.unit):
        element = SubElement(units, "Unit", name=unit)
        powers = build_base_units(unit)
        if powers is not None:
            SubElement(element, "BaseUnit", {name: str(power) for name, power in powers.items() if power})


def build_base_units(unit: str) -> dict[str, int] | None:
    """Return a unit as powers of base units, `N s/m` as kg/s; None if it is not made of units known here.

    A space multiplies and a bar divides by what follows it, which may be a bracket: `N/(m/s)` is N s/m.
    """
    words = re.findall(r"\)\^-?\d+|[()/]|[^\s()/]+", unit)
    try:
        powers = _product(words)
    except (KeyError, ValueError, IndexError, RecursionError):
        return None
    return None if words else powers


def _product(words: list[str]) -> dict[str, int]:
    """Take factors from the words up to a closing bracket, and return their powers."""
    powers: dict[str, int] = {}
    sign = 1
    while words and not words[0].startswith(")"):
        word = words.pop(0)
        if word == "/":
            sign = -1
            continue
        inner = _product(words) if word == "(" else None
        name, _, power = (words.pop(0) if word == "(" else word).partition("^")
        known = inner if inner is not None else {} if name == "1" else _BASE[name]
        for base, exponent in known.items():
            powers[base] = powers.get(base, 0) + sign * int(power or 1) * exponent
        sign = 1
    return powers


def _write(parent: Element, reference: int, variable: Variable) -> None:
    said = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.what,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    initial = {"parameter": "exact", "output": "calculated"}.get(variable.causality)
    element = SubElement(parent, "ScalarVariable", said | ({"initial": initial} if initial else {}))
    start = {} if variable.start is None else {"start": repr(variable.start)}
    SubElement(element, "Real", {**({"unit": variable.unit} if variable.unit else {}), **start})


def _structure(root: Element, variables: tuple[Variable, ...]) -> None:
    """Declare the dependencies of outputs: on no input of the same instant, at the start on the initial state."""
    structure = SubElement(root, "ModelStructure")
    outputs = [k for k, v in enumerate(variables, start=1) if v.causality == "output"]
    at = {v.name: k for k, v in enumerate(variables, start=1)}
    for tag in ("Outputs", "InitialUnknowns"):
        parent = SubElement(structure, tag)
        for k in outputs:
            name, joint = variables[k - 1].name.split("_", 1)
            starts = [at[f"{name}0_{joint}"]] if name in ("q", "v") else [at[n] for n in at if n.startswith("q0_")]
            known = " ".join(map(str, starts)) if tag == "InitialUnknowns" else ""
            SubElement(parent, "Unknown", index=str(k), dependencies=known)
