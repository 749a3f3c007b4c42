"""What a lead-through controller refuses, and the sentence that says why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tau_dyn.exceptions import InputError

if TYPE_CHECKING:
    from tau_dyn.control.lead_through.settings import LeadThroughSettings

_POSITIVE = {"contact_on", "contact_off", "torque_on", "release_force", "speed_limit", "turning_limit", "force_limit"}
_POSITIVE |= {"contact_stiffness", "hand_stiffness", "turning_stiffness", "normal_hz"}
_NOT_NEGATIVE = {"press", "contact_wait", "contact_damping", "correction_range"}


def expand_matrix(name: str, value: float | np.ndarray) -> np.ndarray:
    """Return a 6 x 6 matrix from a number, three or six diagonal entries, or the matrix itself.

    Raises:
        InputError: Another shape, nan, or a matrix that makes its part of the loop active: M must be symmetric and positive
            definite, D must have no negative part, K must be symmetric without negative eigenvalues.
    """
    given = np.asarray(value, float)
    if given.shape not in ((), (1,), (3,), (6,), (6, 6)):
        raise InputError(
            "wrong_shape", f"{name} must be a number, 3 or 6 of them or a 6 x 6 matrix, not of shape {given.shape}"
        )
    if not np.isfinite(given).all():
        raise InputError("invalid_value", f"{name} holds nan or inf; every entry must be a finite number")
    if given.ndim < 2:
        given = np.diag(np.concatenate([given, given]) if given.shape == (3,) else np.broadcast_to(given, 6))
    least = _least(given)
    if name == "mass" and not (least > 0 and np.allclose(given, given.T)):
        raise InputError(
            "invalid_value", f"mass must be symmetric and positive definite; its least eigenvalue is {least:.3g}"
        )
    if name == "damping" and least < 0:
        raise InputError(
            "invalid_value", f"damping has a negative part ({least:.3g}): the handle would push the hand and run away"
        )
    if name == "force_gain" and (least < 0 or not np.allclose(given, given.T)):
        raise InputError(
            "invalid_value",
            f"force_gain must be symmetric and not negative ({least:.3g}): the tool would press ever harder",
        )
    given = given.copy()
    given.setflags(write=False)
    return given


def normalise_axis(name: str, value: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,); raises `InputError` for anything without a direction."""
    given = np.asarray(value, float)
    if given.shape != (3,) or not np.isfinite(given).all() or np.linalg.norm(given) < 1e-9:
        raise InputError("invalid_value", f"{name} must be three finite numbers with a direction, not {value}")
    return given / np.linalg.norm(given)


def require_valid_scalar(name: str, value: object) -> None:
    """Refuse a scalar setting that is no number, or on the wrong side of zero."""
    if name not in _POSITIVE | _NOT_NEGATIVE or value is None:
        return
    number = float(np.asarray(value, float)) if np.ndim(np.asarray(value, float)) == 0 else np.nan
    if not np.isfinite(number):
        raise InputError("invalid_value", f"{name} must be a finite number, not {value}")
    if number < 0 or (name in _POSITIVE and number == 0):
        raise InputError(
            "invalid_value", f"{name} must {'be above' if name in _POSITIVE else 'not be below'} zero, not {number:g}"
        )


def refuse_unstable(s: LeadThroughSettings) -> None:
    """Refuse gains that oscillate in the stated contact, turn the tool unstably, or shake a stated hand.

    Raises:
        InputError: Names the gain, its limit and the frequency at which it would oscillate.
    """
    gain, mass, damping = (np.asarray(m) for m in (s.force_gain, s.mass, s.damping))
    most = float(np.linalg.eigvalsh(gain[:3, :3])[-1])
    _below("force_gain", most, s, s.contact_stiffness, s.contact_damping, "m/s per N", "N/m")
    if s.turns:
        if s.turning_stiffness is None:
            raise InputError(
                "invalid_value",
                "task 'peg' turns the tool: turning_stiffness [N m/rad], the stiffest to expect, is needed",
            )
        most = float(np.linalg.eigvalsh(gain[3:, 3:])[-1])
        _below("force_gain against turning", most, s, s.turning_stiffness, 0.0, "rad/s per N m", "N m/rad")
    decay = s.loop.sample_time * np.abs(np.linalg.eigvals(np.linalg.solve(mass, damping))).max()
    if decay >= 1:
        raise InputError(
            "unstable",
            f"damping / mass is too fast for the sampling: T D / M is {decay:.3g} and must be below 1; "
            f"take a heavier handle, less damping or a shorter sample than {s.loop.sample_time:g} s",
        )
    light, least = float(np.linalg.eigvalsh(mass[:3, :3])[0]), _least(damping[:3, :3])
    limit = s.loop.hand_limit(light, least)
    if s.hand_stiffness >= limit.gain:
        raise InputError(
            "unstable",
            f"a hand of {s.hand_stiffness:g} N/m on a handle of {light:g} kg and {least:g} N s/m oscillates "
            f"at {limit.hz:.1f} Hz; this handle bears {limit.gain:.3g} N/m: more mass or damping is needed",
        )


def _below(what: str, gain: float, s: LeadThroughSettings, stiffness: float, c: float, unit: str, of: str) -> None:
    limit = s.loop.limit(stiffness, c)
    if gain >= limit.gain:
        raise InputError(
            "unstable",
            f"{what} is {gain:.4g} {unit}, but at the stated contact stiffness of {stiffness:g} {of} the loop with a servo of "
            f"{s.loop.servo_hz:g} Hz and {s.loop.delay} sample(s) of delay at {s.loop.sample_time * 1e3:g} ms oscillates "
            f"at {limit.hz:.0f} Hz from {limit.gain:.4g} on; take at most half of that",
        )


def _least(matrix: np.ndarray) -> float:
    """Return the least eigenvalue of a matrix' symmetric part."""
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])
