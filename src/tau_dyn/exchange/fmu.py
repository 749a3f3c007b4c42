"""A model as an FMU for co-simulation (FMI 2.0): the identified robot in a Modelica tool, with the motion of our simulator.

Inputs are the actuators' forces, held during a communication step; outputs are positions, velocities and the tool's position.
The archive holds the C source, a library for this kind of computer, and the description. It runs without this package.
"""

from __future__ import annotations

import hashlib
import io
import platform
import sys
import zipfile
from dataclasses import dataclass
from html import escape

from tau_dyn.codegen import (
    build_equations,
    build_variables,
    format_description,
    format_identifier,
    list_unsupported_effects,
    write_fmu_source,
)
from tau_dyn.effects import acts_on_recording
from tau_dyn.equations import compile_library, find_compiler
from tau_dyn.exchange.content import list_nominal_parameters
from tau_dyn.model import Model
from tau_dyn.simulate import compare_equations
from tau_dyn.version import __version__


def get_library_path(identifier: str) -> str:
    """Return the path of this computer's library in the archive, as FMI 2.0 requires it."""
    if sys.platform == "win32":
        return f"binaries/win64/{identifier}.dll"
    if sys.platform == "darwin":
        return f"binaries/darwin64/{identifier}.dylib"
    machine = platform.machine().lower()
    return f"binaries/{'linux64' if machine in ('x86_64', 'amd64') else f'{machine}-linux'}/{identifier}.so"


_WHEN = (1980, 1, 1, 0, 0, 0)  # fixed date: equal models give equal files


@dataclass(frozen=True, eq=False)
class ExportedFmu:
    """An FMU, and the parts of the model that it lacks.

    Attributes:
        content: The file's bytes.
        left_out: Parts of the model that it cannot carry, one sentence each.
        nominal: Inertial parameters that no data determined; they have their nominal values.
        difference: Largest difference of its equations from the simulator's, relative to the largest value.
    """

    content: bytes
    left_out: tuple[str, ...]
    nominal: tuple[str, ...]
    difference: float


def build_fmu(model: Model) -> ExportedFmu:
    """Return a model as an FMU.

    Raises:
        InputError: A part of the model cannot be written in C, or the C compiler fails.
    """
    left_out = [
        f"effect {e.name} is left out: it feels {why}, which a state alone does not give"
        for e, why in list_unsupported_effects(model)
    ]
    left_out += [
        f"effect {e.name} is left out: it distorts the recording, not the motion"
        for e in model.effects
        if acts_on_recording(e)
    ]
    beyond = [e for e, _ in list_unsupported_effects(model)]
    kept = model.only(e for e in model.effects if e not in beyond and not acts_on_recording(e))
    equations, about = build_equations(kept), _describe(kept)
    difference = compare_equations(equations)
    identifier = format_identifier(kept.robot.name)
    content = write_fmu_source(equations, "", about) + format_description(equations, "", about)
    guid = "{" + hashlib.sha256(content.encode()).hexdigest()[:32] + "}"
    source = write_fmu_source(equations, guid, about)
    names = [v.name for v in build_variables(equations)]
    files = {
        "modelDescription.xml": format_description(equations, guid, about).encode(),
        "sources/fmu.c": source.encode(),
        "documentation/index.html": _page(kept, about, left_out, names).encode(),
    }
    tool = find_compiler()
    if tool is None:
        left_out.append(
            "there is no C compiler here (cc, gcc, clang, or CC), so the FMU holds its source and no library"
        )
    else:
        files[get_library_path(identifier)] = compile_library(source, tool)
    return ExportedFmu(_zipped(files), tuple(left_out), list_nominal_parameters(kept), difference)


def _zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            about = zipfile.ZipInfo(name, _WHEN)
            about.compress_type, about.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(about, content)
    return buffer.getvalue()


def _describe(model: Model) -> str:
    """Return the description of an FMU in one paragraph."""
    leaning = list_nominal_parameters(model)
    effects = ", ".join(effect.name for effect in model.effects) or "none"
    text = f"{model.robot.name}, written by tau_dyn {__version__} from {model.robot.source}. Effects: {effects}."
    return text + (f" Not determined by data, so nominal: {', '.join(leaning)}." if leaning else "")


def _page(model: Model, about: str, left_out: list[str], names: list[str]) -> str:
    """Return the documentation page of the FMU."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in left_out) or "<li>nothing</li>"
    return (
        f"<!doctype html><meta charset='utf-8'><title>{escape(model.robot.name)}</title><h1>{escape(model.robot.name)}</h1>"
        f"<p>{escape(about)}</p><p>Variables: {escape(', '.join(names))}.</p><p>Left out:</p><ul>{items}</ul>"
    )
