r"""Posterior draws of all parameters, given the logs and the robot file; each draw is a possible robot.

    beta ~ N(B theta, c C),   theta ~ N(theta_file, S),   theta consistent

`B` combines parameters into base parameters. `C` is the covariance of least squares. In directions in which 2 s blocks scatter
more, their covariance is used, shrunk towards its mean as so few blocks require (oracle approximating shrinkage). `S` is
25 % of each body's size; parameters without a nominal value, such as friction, have no prior. Consistent: bounds hold and each
body's pseudo-inertia is positive definite. `c >= 1` accounts for the model error (`Widening`). Draws come from
`truncated_normal.py`. A parameter that neither the logs nor the file determine keeps its value in all draws.

Reference: Traversaro et al. 2016; Wensing, Kim & Slotine 2018 (consistency); Chen, Wiesel, Eldar & Hero 2010 (shrinkage);
Birge 1932 (scatter beyond the errors).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

from tau_dyn.estimate import (
    ConvexSet,
    Estimate,
    InertialBody,
    pseudo_inertia,
    sample_truncated_normal,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import write_atomically
from tau_dyn.identify.fitted_model import build_physical_constraints
from tau_dyn.identify.widening import (
    Widening,
    combine_free,
    compute_data_covariance,
    list_prior_stderr,
    measure_logs,
    measure_physics,
    measure_prior,
)
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.results import Brief, format_list

if TYPE_CHECKING:
    import pandas as pd


_MARGINS = (1e-3, 1e-5, 1e-7)
"""Distance of the chains' start from the constraints, relative to a body's size; the largest feasible one is used."""
_MAX_SAMPLES = 100_000  # more fill memory without more information


@dataclass(frozen=True, eq=False)
class Samples(Brief):
    """Draws of a model's parameters.

    Attributes:
        model: The identified model.
        values: One row for each draw, one column for each parameter, in the order of `model.parameters` (n, p).
        widening: Factors by which the variances were widened.
        held: Free parameters that neither the logs nor the robot file determine; all draws have the model's value.
        warnings: Sentences about doubtful results.
        seed: Seed of the random numbers.
    """

    model: Model
    values: np.ndarray
    widening: Widening
    held: tuple[str, ...]
    warnings: tuple[str, ...]
    seed: int

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return self.model.parameters.names

    def to_frame(self) -> pd.DataFrame:
        """Return the draws as a table with named columns."""
        import pandas as pd

        return pd.DataFrame(self.values, columns=list(self.names))

    def build_model(self, k: int) -> Model:
        """Return the model of one draw."""
        return self.model.with_parameters(self.model.parameters.with_values(self.values[k]))

    def save(self, path: str | Path, ending: str = "") -> None:
        """Write the table as Parquet or CSV, completely or not at all.

        Args:
            path: The file.
            ending: `.parquet` or `.csv`; by default the file's own.

        Raises:
            InputError: The ending is another one.
        """
        ending = ending or Path(path).suffix
        require_table_name(Path(path).with_suffix(ending))
        with write_atomically(path) as temporary:
            if ending == ".csv":
                self.to_frame().to_csv(temporary, index=False)
            else:
                self.to_frame().to_parquet(temporary, index=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form: the inputs, and the central 90 % of each parameter's draws."""
        ends = np.quantile(self.values, (0.05, 0.5, 0.95), axis=0).T
        rows = [
            {"name": name, "unit": p.unit, "median": m, "ci90": [low, high]}
            for name, p, (low, m, high) in zip(self.names, self.model.parameters, ends.tolist(), strict=True)
        ]
        return {"n": len(self.values), "widening": self.widening.to_dict(), "held": list(self.held), "parameters": rows}


def require_table_name(path: Path) -> None:
    """Refuse a table's file that is neither Parquet nor CSV.

    Raises:
        InputError: It has another ending.
    """
    if path.suffix not in (".parquet", ".csv"):
        raise InputError("cannot_write", f"{path}: samples are written as .parquet or .csv")


class _Target(NamedTuple):
    """The normal distribution of the varying parameters: `theta = mean + factor @ z`, `z ~ N(0, 1)`."""

    names: tuple[str, ...]
    mean: np.ndarray
    factor: np.ndarray


def draw_samples(model: Model, estimate: Estimate, nominal: Parameters, n: int, *, seed: int = 0) -> Samples:
    """Draw robots from the posterior of an identification.

    Args:
        model: The identified model.
        estimate: Its solved regression.
        nominal: All parameters before the fit.
        n: Number of draws.
        seed: Seed of the random numbers.

    Raises:
        InputError: The number is not positive.
        CannotAnswer: No consistent robot is near the estimate.
    """
    if not 0 < n <= _MAX_SAMPLES:
        raise InputError("bad_option", f"--samples {n}: write a number from 1 to {_MAX_SAMPLES}")
    C = compute_data_covariance(estimate)
    sizes = list_prior_stderr(model, estimate, nominal)
    bodies = [b for b in build_physical_constraints(model).bodies if len(b.parameters) > 1]
    widening = Widening(
        logs=measure_logs(estimate, C), physics=measure_physics(estimate, C, bodies),
        prior=measure_prior(estimate, C, nominal, sizes),
    )  # fmt: skip
    target, held = _build_target(estimate, widening.data * C, nominal, sizes, widening.prior)
    inside = _build_set(target, estimate.parameters, bodies)
    drawn = sample_truncated_normal(inside, _find_start(inside), n, np.random.default_rng([29, seed]))
    values = np.tile(_get_values(estimate, model), (n, 1))
    columns = [model.parameters.names.index(name) for name in target.names]
    values[:, columns] = target.mean + drawn.z @ target.factor.T
    return Samples(
        model, values, widening, held, tuple(_list_warnings(widening, held, drawn.converged, drawn.memory)), seed
    )


def _build_target(
    estimate: Estimate, C: np.ndarray, nominal: Parameters, sizes: np.ndarray, factor: float
) -> tuple[_Target, tuple[str, ...]]:
    """Return the distribution without constraints, and the free parameters that neither data nor prior determine."""
    base, B = estimate.base, combine_free(estimate)
    told = np.isfinite(sizes)
    varying = told.copy()
    varying[base.kept] = True
    now = estimate.parameters.select(base.names).values
    root = linalg.cholesky(C, lower=True)
    A = linalg.solve_triangular(root, B, lower=True)
    y = linalg.solve_triangular(root, estimate.beta_plain - B[:, ~varying] @ now[~varying], lower=True)
    spread = np.sqrt(factor) * sizes[told]
    prior = np.zeros((int(told.sum()), len(base.names)))
    prior[range(len(prior)), told] = 1 / spread
    rows = np.concatenate([A, prior])[:, varying]
    values = np.concatenate([y, nominal.select(base.names).values[told] / spread])
    scale = np.linalg.norm(rows, axis=0)
    Q, R = np.linalg.qr(rows / scale)
    mean = linalg.solve_triangular(R, Q.T @ values) / scale
    inverse = linalg.solve_triangular(R, np.eye(len(R))) / scale[:, None]
    names = tuple(n for n, ok in zip(base.names, varying, strict=True) if ok)
    return _Target(names, mean, inverse), tuple(n for n in base.names if n not in names)


def _build_set(target: _Target, parameters: Parameters, bodies: list[InertialBody]) -> ConvexSet:
    """Return the set with all bounds and consistent bodies, in the target's coordinates; each constraint in units of its size."""
    place = {name: k for k, name in enumerate(target.names)}
    bounds = [
        (side * (target.mean[k] - end), side * target.factor[k])
        for name, k in place.items()
        for side, end in ((1.0, parameters[name].lower), (-1.0, parameters[name].upper))
        if np.isfinite(end)
    ]
    J0, J = [], []
    for body in bodies:
        if not any(name in place for name in body.parameters):
            continue
        pi = body.map @ parameters.select(body.parameters).values
        length = np.sqrt(max(abs(pi[[4, 6, 9]]).sum(), 1e-12) / max(abs(pi[0]), 1e-12))
        unit = np.array([1 / length, 1 / length, 1 / length, 1.0]) / np.sqrt(max(abs(pi[0]), 1e-12))
        middle, slope = np.zeros(10), np.zeros((len(target.names), 10))
        for name, column in zip(body.parameters, body.map.T, strict=True):
            if name in place:
                middle += target.mean[place[name]] * column
                slope += np.outer(target.factor[place[name]], column)
            else:
                middle += parameters[name].value * column
        J0.append(pseudo_inertia(middle) * np.outer(unit, unit))
        J.append(np.array([pseudo_inertia(row) for row in slope]) * np.outer(unit, unit))
    sizes = [max(float(np.linalg.norm(b)), 1e-300) for _, b in bounds]
    d = len(target.names)
    return ConvexSet(
        np.array([a / s for (a, _), s in zip(bounds, sizes, strict=True)]),
        np.array([b / s for (_, b), s in zip(bounds, sizes, strict=True)]).reshape(len(bounds), d),
        np.array(J0).reshape(-1, 4, 4),
        np.stack(J, axis=1) if J else np.zeros((d, 0, 4, 4)),
    )


def _find_start(inside: ConvexSet) -> np.ndarray:
    """Return the most likely point (d,) that keeps a margin to all constraints.

    Raises:
        CannotAnswer: No point keeps a margin.
    """
    d = inside.B.shape[1]
    if inside.contains(np.zeros((1, d)))[0]:
        return np.zeros(d)
    import cvxpy as cp  # slow to import

    for margin in _MARGINS:
        z = cp.Variable(d)
        walls: list[Any] = [inside.a + inside.B @ z >= margin] if len(inside.a) else []
        for k, J0 in enumerate(inside.J0):
            J = cp.reshape(inside.J[:, k].reshape(d, 16).T @ z, (4, 4), order="C")
            walls.append(J0 + (J + J.T) / 2 >> margin * np.eye(4))
        problem = cp.Problem(cp.Minimize(cp.sum_squares(z)), walls)
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            continue
        if z.value is not None and inside.contains(z.value[None])[0]:
            return np.asarray(z.value)
    raise CannotAnswer(
        "infeasible",
        "no robot within the errors of these logs and of the robot file has bodies that may exist",
        "look at the warnings of identify first; a wrong sign, unit or fixed value is the usual reason",
    )


def _get_values(estimate: Estimate, model: Model) -> np.ndarray:
    """Return the model's parameters (p,) at the estimate."""
    return model.parameters.with_values({p.name: p.value for p in estimate.parameters}).values


def _list_warnings(widening: Widening, held: tuple[str, ...], converged: bool, memory: float) -> list[str]:
    said = []
    if held:
        said.append(
            f"neither the logs nor the robot file tell {format_list(held, 4)}; all samples have the model's value"
        )
    if widening.logs > 2:
        said.append(
            f"the logs differ by {widening.logs**0.5:.2g} times what their errors allow; the samples are widened by that factor"
        )
    if widening.physics > 1:
        said.append(
            f"the plain estimate is {widening.physics**0.5:.2g} times as far from any possible robot as its errors allow; the "
            "samples are widened by that factor, and diagnose may name the reason"
        )
    if widening.prior > 2:
        said.append(
            f"the logs contradict the robot file's inertias, whose errors count {widening.prior**0.5:.2g} times; the samples "
            "spread as widely where the logs do not determine them"
        )
    if not converged:
        said.append(
            f"the sampler did not forget its start (correlation {memory:.2g}); do not rely on the samples' spread"
        )
    return said
