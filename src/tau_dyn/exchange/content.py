"""The part of a model that robot files of other programs can carry: each link's inertia, and one law of each joint.

    tau = offset + coulomb sign(v) + viscous v + armature a,     reported as (1 + gain_error) tau

URDF has no offset and no gain. MJCF has both (an actuator's gain and bias), so Coulomb friction that differs by direction is
exact in MJCF: its mean, and half its difference as an offset. Viscous friction is written as the mean of both directions. Other
effects are left out and reported, or use other elements of a format (`mjcf_effects.py`). Data determine only the base
parameters (Khalil & Dombre 2002, ch. 9). If only a combination is identified, the file holds one of many splits with the same
forces.

The module also computes the cost of the omissions: the force error with and without them, on the logs that the model names.
A model file names its held-out logs and their hashes. On these logs both predictions are compared with the measured force,
filtered and masked as in `identify`. If the file names training logs only, the cost is the omitted force along their motion.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.effects import (
    Armature,
    AsymmetricFriction,
    CoulombAsymmetry,
    DriveGain,
    Effect,
    SymmetricFriction,
    TorqueOffset,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import compute_sha256
from tau_dyn.identify import build_force_errors, build_regression
from tau_dyn.log import ColumnMap, Log, read_log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter
from tau_dyn.robot import LinkInertia
from tau_dyn.version import __version__

_BY_JOINT = (SymmetricFriction, AsymmetricFriction, Armature)  # supported by every format
_OF_DRIVES = (CoulombAsymmetry, TorqueOffset, DriveGain)  # expressed by an actuator's gain and bias


@dataclass(frozen=True)
class Exported:
    """The text of a robot file, and the parts of the model that it lacks.

    Attributes:
        text: The file.
        left_out: Parts of the model that the format cannot carry, one sentence each.
        carried: The model with the values that the file has.
        nominal: Inertial parameters that no data excited; they have their nominal values.
        split: Inertial parameters that are identified only in combinations; their values are one of many splits of these
            combinations that give the same forces.
        meshes: Mesh files of the text, by their paths relative to its folder.
        callback: Text of a Python module that adds effects which the format lacks to the program; empty without such effects.
        by_callback: Effects in the callback, one sentence each.
        told: The model with the values of file and callback; None without a callback.
    """

    text: str
    left_out: tuple[str, ...]
    carried: Model
    nominal: tuple[str, ...]
    split: tuple[str, ...] = ()
    meshes: Mapping[str, bytes] = field(default_factory=dict)
    callback: str = ""
    by_callback: tuple[str, ...] = ()
    told: Model | None = None


class BodyInertia(NamedTuple):
    """A link's inertia as in robot files: mass [kg], centre (3,) [m], inertia about the centre (3, 3) [kg m^2]."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


def build_body(link: LinkInertia, model: Model) -> BodyInertia:
    """Return a link's inertia at the model's values, in the link's axes.

    The model's ten numbers are about the joint frame's origin; the parallel axes theorem moves them to the centre.
    """
    pi = link.map @ model.robot.parameters.select(link.names).values
    mass = float(pi[0])
    about_origin = np.array([[pi[4], pi[5], pi[7]], [pi[5], pi[6], pi[8]], [pi[7], pi[8], pi[9]]])
    centre = pi[1:4] / mass if mass > 0 else np.zeros(3)
    shifted = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return BodyInertia(mass, centre, about_origin - shifted)


def build_carried_model(model: Model, *, drives: bool, more: Collection[Effect] = ()) -> Model:
    """Return the model with the values that a file carries; omitted parameters are zero.

    Args:
        model: The model.
        drives: Whether the format has a drive's gain and a constant force.
        more: Further effects of the model that the file carries.
    """
    values = {n: 0.0 for e in _list_unknown(model, drives) if e not in more for n in e.parameters.names}
    for _, _, both in _list_pairs(model, drives):
        values |= dict.fromkeys(both, float(np.mean([model.effect_parameters[n].value for n in both])))
    return model.with_values(values)


def raise_moments(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return principal moments (3,) and axes (3, 3), in columns, of the nearest physically consistent inertia.

    The result is `None` if the inertia (3, 3) is consistent. The second moment of mass along each axis must satisfy
    `s = trace / 2 - moment >= 0`, so that no moment is negative or above the sum of the others. Estimates may violate that, by
    the solver's rounding or by more, and simulators accept only consistent inertias.
    """
    moments, axes = np.linalg.eigh(inertia)
    spread = moments.sum() / 2 - moments
    least = _MARGIN * np.abs(spread).max()
    if spread.min() >= least:
        return None
    spread = np.maximum(spread, least)
    axes[:, 2] *= np.linalg.det(axes)
    return spread.sum() - spread, axes


_MARGIN = 1e-9  # relative, far above the rounding of a program's own check


def _list_unknown(model: Model, drives: bool) -> list[Effect]:
    """Return the effects that a format does not support."""
    known = _BY_JOINT + (_OF_DRIVES if drives else ())
    return [effect for effect in model.effects if not isinstance(effect, known)]


def _list_pairs(model: Model, drives: bool) -> list[tuple[str, str, list[str]]]:
    """Return joint, part of friction and both parameter names, for each pair of directions that a file replaces by its mean."""
    parts = ("viscous",) if drives else ("coulomb", "viscous")
    rows = [(j, p, [f"{j}.{p}_{side}" for side in ("pos", "neg")]) for j in model.robot.actuated for p in parts]
    return [row for row in rows if all(name in model.effect_parameters for name in row[2])]


class CarriedLaw(NamedTuple):
    """The law of a joint in a file; see the module.

    Attributes:
        coulomb: Coulomb friction [N or N m].
        viscous: Viscous friction [N s/m or N m s/rad].
        offset: Constant force [N or N m].
        armature: Drive inertia [kg or kg m^2].
        gain: Reported force divided by true force.
    """

    coulomb: float
    viscous: float
    offset: float
    armature: float
    gain: float


def read_joint_law(carried: Model, joint: str) -> CarriedLaw:
    """Return a joint's law in a model that `build_carried_model` made."""

    def value(name: str) -> float:
        found = carried.effect_parameters
        return found[f"{joint}.{name}"].value if f"{joint}.{name}" in found else 0.0

    pos, neg = value("coulomb_pos"), value("coulomb_neg")
    return CarriedLaw(
        value("coulomb") + (pos + neg) / 2,
        value("viscous") + value("viscous_pos"),
        value("offset") + value("coulomb_asymmetry") + (pos - neg) / 2,
        carried.robot.parameters[f"{joint}.armature"].value + value("armature_error"),
        1 + value("gain_error"),
    )


def list_omissions(model: Model, *, drives: bool) -> tuple[str, ...]:
    """Return the parts of a model that a file does not carry, one sentence each; see `build_carried_model`."""
    said = [
        f"effect {effect.name} of {', '.join(effect.joints)} is left out: the format does not know it"
        for effect in _list_unknown(model, drives)
    ]
    return (*said, *list_means(model, drives=drives))


def list_means(model: Model, *, drives: bool) -> tuple[str, ...]:
    """Return one sentence for each friction parameter that a file holds only as the mean of both directions."""
    said = []
    for joint, part, both in _list_pairs(model, drives):
        a, b = (model.effect_parameters[n].value for n in both)
        if abs(a - b) > 1e-9 * (abs(a) + abs(b)):
            said.append(f"{joint}: {part} friction {a:.4g} and {b:.4g} in the two directions is written as its mean")
    return tuple(said)


def list_nominal_parameters(model: Model) -> tuple[str, ...]:
    """Return the inertial parameters that have their nominal values: no data excited them."""
    return tuple(p.name for p in _inertial(model) if p.stderr is None and not p.split)


def split(model: Model) -> tuple[str, ...]:
    """Return the inertial parameters whose values are an arbitrary split of identified combinations."""
    return tuple(p.name for p in _inertial(model) if p.split)


def _inertial(model: Model) -> list[Parameter]:
    names = dict.fromkeys(name for link in model.robot.links for name in link.names)
    return list(model.robot.parameters.select(list(names)))


def format_header(model: Model, left_out: Sequence[str]) -> str:
    """Return the header of a file, without double hyphens, which XML comments cannot hold, and without control characters."""
    lines = [f"Written by tau_dyn {__version__} from {model.robot.source}."]
    if kept := list_nominal_parameters(model):
        lines.append(f"Nominal values, not identified: {', '.join(kept)}.")
    if shared := split(model):
        lines.append(
            "Identified only in combination; these values are one of many splits with the same forces, and no estimates: "
            f"{', '.join(shared)}."
        )
    lines += [f"{sentence}." for sentence in left_out]
    text = "".join(c if c.isprintable() else "?" for c in " ".join(lines))
    return re.sub("-(?=-)", "- ", text)


def describe_price(model: Model, versions: Sequence[Model], folder: Path) -> str:
    """Return one sentence about the loss of accuracy in a file that lacks a part of `model`.

    Args:
        model: The model, with the provenance of its file.
        versions: The model that the file carries; then, if there is a callback, the model that both carry.
        folder: Folder of the model file; its logs are searched for there and in the working directory.
    """
    try:
        held, trained = (_find_logs(model, use, folder) for use in ("held_out", "trained_on"))
        if held:
            whole, *rest = compute_held_out_errors([model, *versions], held)
            with_each = ", ".join(f"{x:.3g} % with {what}" for x, what in zip(rest, _WHAT, strict=False))
            return f"the held-out force error is {whole:.3g} % with the whole model, {with_each}"
        if trained:
            forces = [_describe_force(model, carried, trained) for carried in versions]
            more = f"; with the callback it leaves out {forces[1]}" if len(forces) > 1 else ""
            return f"the file leaves out {forces[0]} (RMS over the training logs' motion){more}"
    except OSError as fault:
        return f"the loss of accuracy is unknown: a log cannot be read ({fault.strerror or fault})"
    except (InputError, CannotAnswer) as fault:
        return f"the loss of accuracy is unknown: {fault}"
    return "the loss of accuracy is unknown: the model's logs are not here"


_WHAT = ("contents of the file", "the callback in addition")


def _describe_force(model: Model, carried: Model, logs: Sequence[Log]) -> str:
    """Return a sentence with the RMS of the omitted force by joint."""
    lost = compute_lost_force(model, carried, logs)
    rows = zip(model.robot.actuated, lost, model.robot.force_units, strict=True)
    parts = [f"{x:.3g} {unit} at {joint}" for joint, x, unit in rows if x > 0.0]
    return ", ".join(parts) or "no force"


def compute_held_out_errors(models: Sequence[Model], logs: Sequence[Log]) -> list[float]:
    """Return the relative force error [%] of versions of one model, all on the same filtered samples."""
    regression = build_regression(models[0], logs)
    return [build_force_errors(regression, m.parameters.values).relative_error_percent for m in models]


def compute_lost_force(model: Model, carried: Model, logs: Sequence[Log]) -> np.ndarray:
    """Return the RMS (na,) [N or N m] of the omitted force along the logs' motion."""
    change = model.parameters.values - carried.parameters.values
    rows = [(run.W @ change, run.usable) for run in build_regression(model, logs).runs]
    lost, usable = (np.concatenate(part) for part in zip(*rows, strict=True))
    return np.sqrt((lost**2 * usable).sum(axis=0) / np.maximum(usable.sum(axis=0), 1))


def _find_logs(model: Model, use: str, folder: Path) -> list[Log]:
    """Return a model's logs, each read by its column map; an empty list if one is missing or has changed."""
    found = []
    for row in model.provenance.get(use, []):
        log = _find_log(row, folder)
        if log is None:
            return []
        found.append(log)
    return found


def _find_log(row: Mapping[str, Any], folder: Path) -> Log | None:
    """Return the log of a row of provenance, or `None` if no file has its hash."""
    columns = row.get("columns") if isinstance(row, Mapping) else None
    if not isinstance(row, Mapping) or not isinstance(row.get("path"), str) or not isinstance(columns, dict | None):
        return None
    map_ = None if columns is None else ColumnMap.from_dict(columns, "the model's column map")
    several = map_ is not None and bool(map_.files)  # the hash of a log of several files covers all their bytes
    name = Path(row["path"])
    for path in dict.fromkeys((name, folder / name, folder / name.name)):
        is_folder = path.is_dir()  # a ROS 2 bag; its hash covers its files
        if is_folder or path.is_file() and (several or compute_sha256(path) == row.get("sha256")):
            log = read_log(path, map_)
            if log.sha256 == row.get("sha256"):
                return log
    return None
