"""A chosen model without one cause: the same geometry with that cause's parameters held, so that their gain can be measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.calibrate.geometry import ConstrainedGeometry, Geometry, constrain_parameters
from tau_dyn.parameters import Parameter, Parameters

LENGTHS = (".length", ".rods_length")
PLACES = (".origin_", ".base_", ".plate_", ".turn_")


def fix_lengths(geometry: Geometry) -> Geometry | None:
    """Return the geometry with nominal rod lengths."""
    return _left_out(geometry, [n for n in _free(geometry) if n.endswith(LENGTHS)])


def fix_placements(geometry: Geometry) -> Geometry | None:
    """Return the geometry with all joints where the robot file has them."""
    return _left_out(geometry, [n for n in _free(geometry) if any(w in n for w in PLACES)])


def fix_tilts(geometry: Geometry) -> Geometry | None:
    """Return the geometry with rods' ends on their carts' lines."""
    return _left_out(geometry, [n for n in _free(geometry) if ".drift_" in n])


def tie_guideway_directions(geometry: Geometry) -> Geometry | None:
    """Return the geometry with guideways in one direction, each drive with its own scale."""
    owners = _rails(geometry)
    if len(owners) < 2:
        return None
    names, value = (
        geometry.parameters.names,
        dict(zip(geometry.parameters.names, geometry.parameters.values, strict=True)),
    )
    along, first, second = _axes(owners[0], value)
    rows = [(f"{o}.scale", {o: along}) for o in owners]
    rows += [("guideways.slope_1", dict.fromkeys(owners, first)), ("guideways.slope_2", dict.fromkeys(owners, second))]
    return _recombined(geometry, owners, rows, names)


def fix_drive_scales(geometry: Geometry) -> Geometry | None:
    """Return the geometry with drives of nominal scale, each guideway with its own direction."""
    owners = _rails(geometry)
    if not owners:
        return None
    names, value = (
        geometry.parameters.names,
        dict(zip(geometry.parameters.names, geometry.parameters.values, strict=True)),
    )
    rows = []
    for o in owners:
        _, first, second = _axes(o, value)
        rows += [(f"{o}.slope_1", {o: first}), (f"{o}.slope_2", {o: second})]
    return _recombined(geometry, owners, rows, names)


def _free(geometry: Geometry) -> list[str]:
    return [p.name for p in geometry.parameters if p.free]


def _left_out(geometry: Geometry, names: Sequence[str]) -> Geometry | None:
    return constrain_parameters(geometry, {}, names) if names else None


def _rails(geometry: Geometry) -> list[str]:
    return [n.removesuffix(".direction_x") for n in geometry.parameters.names if n.endswith(".direction_x")]


def _axes(owner: str, value: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    d = np.array([value[f"{owner}.direction_{a}"] for a in "xyz"])
    d = d / np.linalg.norm(d)
    _, _, vt = np.linalg.svd(d[None])
    return d, vt[1], vt[2]


def _recombined(
    geometry: Geometry, owners: Sequence[str], rows: list[tuple[str, dict[str, np.ndarray]]], names: Sequence[str]
) -> ConstrainedGeometry:
    """Return the geometry with its directions replaced by a few combinations of them."""
    directions = {f"{o}.direction_{a}" for o in owners for a in "xyz"}
    kept = [k for k, n in enumerate(names) if n not in directions]
    index = {n: k for k, n in enumerate(names)}
    matrix = np.zeros((len(names), len(kept) + len(rows)))
    matrix[kept, range(len(kept))] = 1.0
    for r, (_, parts) in enumerate(rows):
        for owner, vector in parts.items():
            for a, x in zip("xyz", vector, strict=True):
                matrix[index[f"{owner}.direction_{a}"], len(kept) + r] = x
    old = list(geometry.parameters)
    parameters = Parameters([*(old[k] for k in kept), *(Parameter(n, 0.0, "1") for n, _ in rows)])
    last = int(geometry.priority.max(initial=0))
    return ConstrainedGeometry(
        geometry, parameters, matrix, np.concatenate([geometry.priority[kept], np.full(len(rows), last, int)])
    )
