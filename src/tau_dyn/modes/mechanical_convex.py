r"""M, D and K from a response as a conic program.

    minimise sum_k || W_k ((K + s_k D + s_k^2 M) H_k - B) ||^2   subject to   M > 0,  K > 0,  D >= 0,  all symmetric

with Sanathanan and Koerner's weights `W_k = (K + s_k D + s_k^2 M)^{-1} / ||H_k||` of the round before, which turn the equation's
error into the response's relative error. Everything is in scaled units, where M, D, K are of order one. References: Sanathanan &
Koerner 1963; Boyd & Vandenberghe 2004, 4.6.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np

from tau_dyn.modes.second_order import SecondOrder, build_symmetric_basis, pack, unpack

_MAX_ITERATIONS = 8  # convex programmes one after the other; each starts from the last one's weights
_MARGIN = 1e-6
"""Least eigenvalue of M and K, as a part of their largest, that counts as positive."""
_MIN_EIGENVALUE = 1e-4
"""Least eigenvalue that the program gives M and K, in scaled units."""


def solve_conic(s: np.ndarray, H: np.ndarray, driven: tuple[int, ...]) -> SecondOrder:
    """Return the structure nearest to a response that watches every degree of freedom.

    Args:
        s: Complex frequencies (F,), scaled.
        H: Displacement over force (F, n, m), scaled.
        driven: Degree of freedom that each input pushes.
    """
    n = H.shape[1]
    size = np.linalg.norm(H, axis=(1, 2))[:, None, None]
    W = np.broadcast_to(np.eye(n), (len(s), n, n))
    x = np.zeros(3 * n * (n + 1) // 2)
    found, last = unpack(x, n), x
    for _ in range(_MAX_ITERATIONS):
        R, target = _triangle(s, H, W, driven)
        x = np.linalg.lstsq(R, target, rcond=None)[0]
        found = unpack(x, n)
        if not is_physical(found):
            found = _program(R, target, n)
        x = pack(found)
        if np.linalg.norm(x - last) < 1e-6 * np.linalg.norm(x):
            break
        last, W = x, found.compliance(s) / size
    return found


def is_physical(structure: SecondOrder) -> bool:
    """Return whether M > 0, K > 0 and D >= 0."""
    lowest = {name: np.linalg.eigvalsh(getattr(structure, name)) for name in "MDK"}
    return all(lowest[name][0] > _MARGIN * abs(lowest[name][-1]) for name in "MK") and lowest["D"][0] >= 0


def _triangle(s: np.ndarray, H: np.ndarray, W: np.ndarray, driven: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the equations as a triangle: `R x = target` in the entries of M, D, K."""
    n = H.shape[1]
    blocks = np.einsum("kij,qjl,klm->kimq", W, build_symmetric_basis(n), H)
    columns = np.concatenate([blocks * s[:, None, None, None] ** power for power in (2, 1, 0)], axis=3)
    rows = columns.reshape(-1, columns.shape[3])
    target = (W @ np.eye(n)[:, list(driven)]).ravel()
    R = np.linalg.qr(np.column_stack([np.vstack([rows.real, rows.imag]), np.concatenate([target.real, target.imag])]))[
        1
    ]
    return R[:-1, :-1], R[:-1, -1]


def _program(R: np.ndarray, target: np.ndarray, n: int) -> SecondOrder:
    """Return the constrained minimum."""
    from cvxpy import SolverError  # slow to import, and most fits never need it

    problem, parts, (R_now, target_now) = _problem(n)
    R_now.value, target_now.value = R, target
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an inaccurate solution is judged by its fit, later
        try:
            problem.solve(solver="CLARABEL")
        except SolverError:
            return _clipped(R, target, n)
    if any(part.value is None for part in parts):
        return _clipped(R, target, n)
    return SecondOrder(*(0.5 * (part.value + part.value.T) for part in parts))


def _clipped(R: np.ndarray, target: np.ndarray, n: int) -> SecondOrder:
    """Return the plain minimum with its eigenvalues raised to what is physical: a start, where the solver gives up."""
    raised = []
    plain = unpack(np.linalg.lstsq(R, target, rcond=None)[0], n)
    for part, least in ((plain.M, _MIN_EIGENVALUE), (plain.D, 0.0), (plain.K, _MIN_EIGENVALUE)):
        value, vector = np.linalg.eigh(part)
        raised.append((vector * np.maximum(value, least)) @ vector.T)
    return SecondOrder(*raised)


@cache
def _problem(n: int) -> tuple[Any, list[Any], tuple[Any, Any]]:
    """Return the program, its variables M, D, K and its data; written once, since writing takes longer than solving."""
    import cvxpy as cp

    parts = [cp.Variable((n, n), symmetric=True) for _ in range(3)]
    x = cp.hstack([part[i, j] for part in parts for i, j in zip(*np.triu_indices(n), strict=True)])
    R, target = cp.Parameter((x.size, x.size)), cp.Parameter(x.size)
    least = [_MIN_EIGENVALUE * np.eye(n), np.zeros((n, n)), _MIN_EIGENVALUE * np.eye(n)]
    constraints = [part >> edge for part, edge in zip(parts, least, strict=True)]
    return cp.Problem(cp.Minimize(cp.sum_squares(R @ x - target)), constraints), parts, (R, target)
