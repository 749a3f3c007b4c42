"""Exchanged or reversed sensors that would make the named pairs of force and sensor reciprocal.

At a mode of an undamped or lightly damped structure the residue of displacement over force is `psi psi' / (2 i omega)`:
symmetric, and with a negative imaginary part at every driving point (Ewins 2000, 2.3). Sensors in another order or with
another sign break one or the other, and one order and set of signs restores both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from tau_dyn.modes.mechanical.fit import measure_asymmetry
from tau_dyn.modes.mechanical.structure import Evidence, Places

MAX_PAIRS = 4  # of force and sensor; five have 3840 orders and signs, of which chance would restore some
MIN_PHASE = 0.5
"""Part of a residue at a driving point that must be negative imaginary; 1 without damping."""
MIN_SIZE = 0.05
"""Size of a driving point's residue, over the largest of its mode, below which its phase says nothing."""


def describe_wiring(evidence: Evidence, places: Places, limit: float, names: Sequence[str]) -> str:
    """Return the smallest change of sensors that makes the pairs reciprocal, as a sentence; empty if none or several do.

    Args:
        evidence: The model, with a known kind of sensor.
        places: Which degree of freedom each input and output belongs to.
        limit: Relative asymmetry of residues that counts as reciprocal.
        names: Names of the outputs.
    """
    if not 1 <= len(places.pairs) <= MAX_PAIRS or len(names) < len(places.sensed):
        return ""
    found = [
        (len(moved) + len(turned), moved, turned)
        for changed, signs, moved, turned in _list_changes(places)
        if _is_reciprocal(evidence, changed, signs, limit)
    ]
    least = [row for row in found if row[0] == min(found)[0]]
    if len(least) != 1:
        return ""
    _, moved, turned = least[0]
    changes = [f"{' and '.join(names[i] for i in moved)} exchanged"] if moved else []
    changes += [f"the sign of {' and '.join(names[i] for i in turned)} reversed"] if turned else []
    return f"with {' and '.join(changes)} the pairs agree: look at the cables and at how the sensors are mounted"


def _list_changes(places: Places) -> Iterator[tuple[Places, np.ndarray, list[int], list[int]]]:
    """Yield other places of the paired outputs and signs of all outputs (p,), with the outputs moved and those reversed."""
    own = [i for _, i in places.pairs]
    for order in permutations(own):
        sensed = list(places.sensed)
        for i, other in zip(own, order, strict=True):
            sensed[other] = places.sensed[i]
        moved = [i for i, other in zip(own, order, strict=True) if i != other]
        for flips in product((False, True), repeat=len(own)):
            turned = [i for i, flip in zip(own, flips, strict=True) if flip]
            signs = np.ones(len(sensed))
            signs[turned] = -1.0
            if moved or turned:
                yield Places(tuple(sensed), places.driven), signs, moved, turned


def _is_reciprocal(evidence: Evidence, places: Places, signs: np.ndarray, limit: float) -> bool:
    """Return whether residues from the paired forces to their outputs are symmetric, with driving points in phase."""
    uneven, stderr = measure_asymmetry(evidence, places, signs)
    if uneven > max(limit, 4 * stderr):
        return False
    return are_driving_points_in_phase(evidence, places, signs)


def are_driving_points_in_phase(evidence: Evidence, places: Places, signs: np.ndarray | float = 1.0) -> bool:
    """Return whether each paired output (p,), times its sign, moves as the force at its place pushes it at every mode."""
    residues = evidence.at.residues
    scaled = np.broadcast_to(signs, residues.shape[1])[:, None] * residues / places.unit(residues)
    at_place = np.stack([scaled[:, i, j] for j, i in places.pairs], axis=1)
    heard = np.abs(at_place) > MIN_SIZE * np.abs(at_place).max(axis=1, keepdims=True)
    return bool(np.all(-at_place.imag[heard] > MIN_PHASE * np.abs(at_place[heard])))
