"""M, D and K from a response: a conic program, then maximum likelihood, all in scaled units, where M, D, K are of order one.

    minimise sum_k || W_k ((K + s_k D + s_k^2 M) H_k - B) ||^2   subject to   M > 0,  K > 0,  D >= 0,  all symmetric
    minimise || T (H(M, D, K) - H_model) ||^2,   M = L_M L_M',  D = L_D L_D',  K = L_K L_K'

The program has Sanathanan and Koerner's weights `W_k = (K + s_k D + s_k^2 M)^{-1} / ||H_k||` of the round before, which
turn the equation's error into the response's relative error. In the likelihood, `T` whitens: it contains the covariance
of the response that follows from the model's parameter covariance, so no information in the parameters is lost (Stoica
& Soderstrom 1989, indirect identification). Cholesky factors keep the matrices definite at every step; standard errors
are those of the matrix entries. References: Sanathanan & Koerner 1963; Boyd & Vandenberghe 2004, 4.6.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from tau_dyn.modes.mechanical.structure import Places, SecondOrder, build_symmetric_basis, pack, unpack

_MAX_ITERATIONS = 8  # convex programmes one after the other; each starts from the last one's weights
_MARGIN = 1e-6  # least eigenvalue of M and K, as a part of their largest, that counts as positive
_MIN_EIGENVALUE = 1e-4  # least eigenvalue that the program gives M and K, in scaled units


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
    """Return the unconstrained minimum with its eigenvalues raised to physical values: a start if the solver fails."""
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


_RANK = 1e-7  # directions of the response's error smaller than this part of the largest are rounding, not knowledge


@dataclass(frozen=True, eq=False)
class Target:
    """The response that a structure is to reproduce.

    Attributes:
        s: Complex frequencies (F,).
        H: Displacement over force (F, p, m).
        places: The degrees of freedom of its inputs and outputs.
        T: Rows (r, 2 F p m) that weigh the error, real parts first; or one weight for each of its entries (2 F p m,).
        whitens: Whether `T` times the error of H is white with variance one.
    """

    s: np.ndarray
    H: np.ndarray
    places: Places
    T: np.ndarray
    whitens: bool

    def misfit(self, structure: SecondOrder) -> np.ndarray:
        """Return the weighed error (r,)."""
        return self.weigh(self.places.select(structure.compliance(self.s)) - self.H)

    def weigh(self, values: np.ndarray) -> np.ndarray:
        """Return complex changes of the response (F, p, m, ...) weighed (r, ...)."""
        rows = split(values)
        return self.T @ rows if self.T.ndim == 2 else (rows.T * self.T).T

    def jacobian(self, structure: SecondOrder) -> np.ndarray:
        """Return its derivative (r, 3n(n+1)/2) with respect to the entries of M, D, K."""
        G = structure.compliance(self.s)
        left, right = G[:, list(self.places.sensed)], G[:, :, list(self.places.driven)]
        change = -np.moveaxis(left[:, None] @ build_symmetric_basis(self.places.n) @ right[:, None], 1, 3)
        powers = [change * self.s[:, None, None, None] ** power for power in (2, 1, 0)]
        return self.weigh(np.concatenate(powers, axis=3))


def split(values: np.ndarray) -> np.ndarray:
    """Return complex values (F, p, m, ...) as reals (2 F p m, ...), real parts first."""
    flat = values.reshape(-1, *values.shape[3:])
    return np.concatenate([flat.real, flat.imag])


def compute_whitening(factor: np.ndarray) -> np.ndarray:
    """Return rows `T` with `T C T' = I` on the span of a covariance `C = F F'`.

    Args:
        factor: `F` (rows, r), real.
    """
    size = np.sqrt(np.mean(factor**2, axis=1))  # scale rows first, or the rank is that of the largest rows
    size = np.where(size > 1e-300, size, np.inf)
    U, S, _ = np.linalg.svd(factor / size[:, None], full_matrices=False)
    keep = S > _RANK * S[0]
    return (U[:, keep] / S[keep]).T / size


def maximise_likelihood(target: Target, start: SecondOrder) -> SecondOrder:
    """Return the structure of least weighed error, definite throughout."""
    n = target.places.n

    def factors(z: np.ndarray) -> np.ndarray:
        L = np.zeros((3, n, n))
        L[:, *np.tril_indices(n)] = z.reshape(3, -1)
        return L

    def structure(z: np.ndarray) -> SecondOrder:
        L = factors(z)
        return SecondOrder(*(L @ L.transpose(0, 2, 1)))

    def slope(z: np.ndarray) -> np.ndarray:
        return target.jacobian(structure(z)) @ _chain(factors(z))

    def safe(z: np.ndarray) -> np.ndarray:
        return np.nan_to_num(target.misfit(structure(z)), nan=1e12, posinf=1e12, neginf=-1e12)

    begin = np.concatenate([_factor(part)[np.tril_indices(n)] for part in (start.M, start.D, start.K)])
    stop = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12, "max_nfev": 60}
    # MINPACK asks for as many residuals as unknowns; of nearly exact data fewer are left to weigh
    method = "lm" if len(safe(begin)) >= len(begin) else "trf"
    found = least_squares(safe, begin, jac=slope, method=method, x_scale="jac", **stop)  # pyright: ignore[reportArgumentType]
    return structure(found.x)


def compute_relative_frame(structure: SecondOrder) -> np.ndarray:
    """Return the change (q, q) of entries per unit of `E` in `L (I + E) L'`: units and coordinates drop out of `E`."""
    blocks = []
    for part in (structure.M, structure.D, structure.K):
        L = _factor(part)
        moved = L @ build_symmetric_basis(len(part)) @ L.T
        blocks.append(moved[:, *np.triu_indices(len(part))].T)
    size = len(blocks[0])
    frame = np.zeros((3 * size, 3 * size))
    for k, block in enumerate(blocks):
        frame[k * size : (k + 1) * size, k * size : (k + 1) * size] = block
    return frame


def _factor(part: np.ndarray) -> np.ndarray:
    """Return a lower factor of a matrix, with its eigenvalues raised to at least a millionth of the largest.

    At an eigenvalue of zero the gradient of the likelihood vanishes, and the search would not leave it.
    """
    value, vector = np.linalg.eigh(part)
    value = np.maximum(value, 1e-6 * max(value[-1], 1e-12))
    R = np.linalg.qr((vector * np.sqrt(value)).T)[1]
    return (R * np.sign(np.diag(R))[:, None]).T


def _chain(L: np.ndarray) -> np.ndarray:
    """Return the derivative (q, q) of the entries of `L L'` with respect to those of L, for three factors."""
    n = L.shape[1]
    rows, columns = np.tril_indices(n)
    upper = np.triu_indices(n)
    size = len(rows)
    out = np.zeros((3 * size, 3 * size))
    for part in range(3):
        for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
            change = np.zeros((n, n))
            change[i] = L[part][:, j]
            out[part * size : (part + 1) * size, part * size + k] = (change + change.T)[upper]
    return out
