"""What an exported feedforward says of itself, in any language: provenance, joints and units, effects, parameter values."""

from __future__ import annotations

from collections.abc import Iterator

from tau_dyn.control.export_model import Program
from tau_dyn.version import __version__


def yield_description(program: Program) -> Iterator[str]:
    """Yield lines of plain text for the head of an exported file."""
    feedforward = program.feedforward
    model, robot = feedforward.model, feedforward.model.robot
    yield f"Feedforward forces of {robot.name}, written by tau-dyn {__version__}."
    yield f"Robot: {robot.source}" + (f", sha256 {robot.sha256}" if robot.sha256 else "")
    for key, value in model.provenance.items():
        yield f"{key}: {value}"
    yield ""
    yield "Joints, in the order of all arrays; positions, speeds, accelerations and forces in"
    rows = zip(robot.actuated, robot.position_units, robot.force_units, feedforward.width, strict=True)
    for k, (joint, place, force, width) in enumerate(rows):
        yield f"  [{k}] {joint}: {place}, {place}/s, {place}/s^2, {force}; sign smoothed within {width:g} {place}/s"
    yield f"Shape of the smoothed sign: {feedforward.shape}."
    for name in program.signals:
        yield f"Further argument {name}, one a joint" + (
            " [degC], past the lag of its effect" if name == "temperature" else ""
        )
    yield ""
    yield "Effects:" if model.effects else "No effects: the rigid robot alone."
    for effect in model.effects:
        settings = "".join(f", {k} = {x:g}" for k, x in effect.settings.items())
        yield f"  {effect.name} ({', '.join(effect.joints)}{settings}): {effect.equation}"
    yield "Parameters (their values are folded into the code):"
    for p in model.parameters:
        error = f" +- {p.stderr:.2g}" if p.stderr is not None else ""
        yield f"  {p.name} = {p.value:.9g}{error} {p.unit}"
    yield ""
    yield f"Checked when it was written: within {max(program.difference, 1e-16):.1g} of Python's, relative to the largest force."
