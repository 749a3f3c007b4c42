"""A model as an FMU for co-simulation (FMI 2.0): the identified robot in a Modelica tool, moving as our simulator moves it.

Inputs are the actuators' forces, held during a communication step; outputs are positions, velocities and the tool's place. The
archive holds the C source, a library for this kind of computer, and the description. It asks for nothing of ours when it runs.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from dataclasses import dataclass
from html import escape

from tau_dyn.effects import acts_on_recording
from tau_dyn.exchange.content import list_nominal_parameters
from tau_dyn.exchange.fmu_build import compile_library, find_compiler, get_library_path
from tau_dyn.exchange.fmu_check import compute_largest_difference
from tau_dyn.exchange.fmu_description import build_variables, format_description, format_identifier
from tau_dyn.exchange.fmu_equations import build_equations, list_unsupported_effects
from tau_dyn.exchange.fmu_source import describe_fmu, format_source
from tau_dyn.model import Model

_WHEN = (1980, 1, 1, 0, 0, 0)  # the same model is the same file


@dataclass(frozen=True, eq=False)
class ExportedFmu:
    """An FMU and what it does not say.

    Attributes:
        content: The file's bytes.
        left_out: What of the model it cannot carry, a sentence each.
        nominal: Inertial parameters that no data determined and that stand at their nominal values.
        difference: Largest difference of its equations from the simulator's, relative to the largest value.
    """

    content: bytes
    left_out: tuple[str, ...]
    nominal: tuple[str, ...]
    difference: float


def build_fmu(model: Model) -> ExportedFmu:
    """Return a model as an FMU.

    Raises:
        InputError: Something of the model cannot be written in C, or the C compiler fails.
    """
    left_out = [
        f"effect {e.name} is left out: it feels {why}, which a state alone does not give"
        for e, why in list_unsupported_effects(model)
    ]
    left_out += [
        f"effect {e.name} is left out: it distorts what is recorded, not the motion"
        for e in model.effects
        if acts_on_recording(e)
    ]
    beyond = [e for e, _ in list_unsupported_effects(model)]
    kept = model.only(e for e in model.effects if e not in beyond and not acts_on_recording(e))
    equations = build_equations(kept)
    difference = compute_largest_difference(equations)
    identifier = format_identifier(kept.robot.name)
    body = format_source(equations, "")
    guid = "{" + hashlib.sha256((body + format_description(equations, "")).encode()).hexdigest()[:32] + "}"
    source = format_source(equations, guid)
    files = {
        "modelDescription.xml": format_description(equations, guid).encode(),
        "sources/fmu.c": source.encode(),
        "documentation/index.html": _page(kept, left_out, [v.name for v in build_variables(equations)]).encode(),
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


def _page(model: Model, left_out: list[str], names: list[str]) -> str:
    """Return what the FMU says of itself to a person."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in left_out) or "<li>nothing</li>"
    return (
        f"<!doctype html><meta charset='utf-8'><title>{escape(model.robot.name)}</title><h1>{escape(model.robot.name)}</h1>"
        f"<p>{escape(describe_fmu(model))}</p><p>Variables: {escape(', '.join(names))}.</p><p>Left out:</p><ul>{items}</ul>"
    )
