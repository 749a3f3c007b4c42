"""What other programs' robot files can carry of a model: each link's inertia, and one friction of each joint.

Neither URDF nor MJCF knows friction that differs by direction, and neither knows our other effects: friction is written as the
mean of both directions, the rest is left out, and both are said. Base parameters alone are what data determine
(Khalil & Dombre 2002, ch. 9). Where only a combination is identified, the file holds one of many splits with the same forces.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.effects import AsymmetricFriction, SymmetricFriction
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter
from tau_dyn.robot import LinkInertia
from tau_dyn.version import __version__

_PARTS = {"coulomb": ("coulomb", "coulomb_pos", "coulomb_neg"), "viscous": ("viscous", "viscous_pos", "viscous_neg")}


@dataclass(frozen=True)
class Exported:
    """A robot file's text and what it does not say.

    Attributes:
        text: The file.
        left_out: What of the model the format cannot carry, a sentence each.
        nominal: Inertial parameters that no data excited; they have their nominal values.
        split: Inertial parameters of which only combinations are identified; their values are one of many splits of these
            combinations that give the same forces.
    """

    text: str
    left_out: tuple[str, ...]
    nominal: tuple[str, ...]
    split: tuple[str, ...] = ()


class BodyInertia(NamedTuple):
    """A link's inertia as files write it: mass [kg], centre (3,) [m], inertia about the centre (3, 3) [kg m^2]."""

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


def raise_moments(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return principal moments (3,) and axes (3, 3), in columns, of the next inertia that a body may have.

    None where the inertia (3, 3) is a body's: its mass spreads by `s = trace / 2 - moment >= 0` along each axis, so no moment is
    negative or above the sum of the others. Estimates may miss that, by the solver's rounding or by more, and programs that
    simulate take nothing else.
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


def compute_friction(model: Model, joint: str) -> dict[str, float]:
    """Return a joint's `coulomb` [N or N m] and `viscous` friction, each the mean of both directions."""
    found = {}
    for part, names in _PARTS.items():
        values = [
            model.effect_parameters[f"{joint}.{n}"].value for n in names if f"{joint}.{n}" in model.effect_parameters
        ]
        found[part] = float(np.mean(values)) if values else 0.0
    return found


def list_omitted_effects(model: Model) -> tuple[str, ...]:
    """Return what neither format can carry, a sentence each."""
    said = []
    for effect in model.effects:
        if not isinstance(effect, SymmetricFriction | AsymmetricFriction):
            said.append(f"effect {effect.name} of {', '.join(effect.joints)} is left out: the format does not know it")
    for joint in model.robot.actuated:
        for part in _PARTS:
            both = [f"{joint}.{part}_{side}" for side in ("pos", "neg")]
            if all(n in model.effect_parameters for n in both):
                a, b = (model.effect_parameters[n].value for n in both)
                if abs(a - b) > 1e-9 * (abs(a) + abs(b)):
                    said.append(
                        f"{joint}: {part} friction {a:.4g} and {b:.4g} in the two directions is written as its mean"
                    )
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


def format_header(model: Model) -> str:
    """Return what a file says about itself: no two hyphens in a row, which XML comments cannot hold, no control characters."""
    lines = [f"Written by tau_dyn {__version__} from {model.robot.source}."]
    if kept := list_nominal_parameters(model):
        lines.append(f"Nominal values, not identified: {', '.join(kept)}.")
    if shared := split(model):
        lines.append(
            "Identified only in combination; these values are one of many splits with the same forces, and no estimates: "
            f"{', '.join(shared)}."
        )
    lines += [f"{sentence}." for sentence in list_omitted_effects(model)]
    text = "".join(c if c.isprintable() else "?" for c in " ".join(lines))
    return re.sub("-(?=-)", "- ", text)
