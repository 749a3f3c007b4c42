"""Structure in the residual that no named cause explains.

The residual of each output is tried against smooth functions (Legendre, degree 4) of every variable, products (degree 2 by 2)
of every pair, and both times the direction of motion, in the same white rows and against the same noise draws as the causes.
Significant structures are confirmed like causes. A formula is the single product of simple terms that explains nearly as much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap, compute_artefact_chance
from tau_dyn.evidence.null_model import (
    SMOOTH_DEGREE,
    WHOLE_TIME,
    JoinedVariables,
    WhiteResidual,
    compute_overdispersion,
    compute_statistics_of_rows,
    count_effective_tests,
)

Values = Mapping[str, np.ndarray]
"""Variable -> its values (n,) in one run, such as `v_cart1`, `tau_cart1` (the predicted force) or `t`."""

_SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "{}": lambda x: x,
    "{}^2": lambda x: x**2,
    "{}^3": lambda x: x**3,
    "|{}|": np.abs,
    "{0} |{0}|": lambda x: x * np.abs(x),
    "sign({})": np.sign,
}


PAIR_DEGREE = 2
"""Degree of the smooth functions of each variable of a pair, whose products are tried."""


class Dependence(NamedTuple):
    """A force at `output` as a smooth function of `names`, times the direction of motion of joint `turns`, if one is named."""

    output: str
    names: tuple[str, ...]
    turns: str = ""

    @property
    def variables(self) -> tuple[str, ...]:
        """All variables that it depends on; for a direction of motion, the speed whose sign it is."""
        speed = f"v_{self.turns}"
        return self.names if not self.turns or speed in self.names else (*self.names, speed)

    @property
    def further(self) -> int:
        """Number of variables it depends on beyond one variable and the output's own direction."""
        return len(self.names) - 1 + (self.turns not in ("", self.output))

    def bases(self, values: Sequence[Values]) -> list[np.ndarray]:
        """Return smooth columns (n, k) of each run: Legendre, degree 4, or 2 by 2 of a pair."""
        joined = JoinedVariables(values)
        return joined.split(self.build_columns(joined))

    def build_columns(self, joined: JoinedVariables) -> np.ndarray:
        """Return its smooth columns (N, k) over all runs."""
        if len(self.names) == 1:
            columns = joined.smooth(self.names[0], SMOOTH_DEGREE)
            if self.names == ("t",) and WHOLE_TIME in joined.values:
                columns = columns + joined.smooth(WHOLE_TIME, SMOOTH_DEGREE)
        else:
            one, other = (joined.smooth(name, PAIR_DEGREE) for name in self.names)
            columns = [a * b for a in one for b in other]
        if not columns:
            return np.zeros((len(joined.values[self.names[0]]), 0))
        stacked = np.stack(columns)
        return (stacked * np.sign(joined.values[f"v_{self.turns}"]) if self.turns else stacked).T

    def terms(self, values: Sequence[Values]) -> dict[str, list[np.ndarray]]:
        """Return simple products (n, 1) of each run by their labels."""
        names, found = self.names, {}
        for first, f in _SHAPES.items():
            seconds = _SHAPES.items() if len(names) == 2 else [("", lambda x: np.ones_like(x))]
            for second, g in seconds:
                label = " * ".join(x for x in (first.format(names[0]), second.format(names[-1])) if x)
                product = [(f(v[names[0]]) * g(v[names[-1]]))[:, None] for v in values]
                found[label] = product
                for speed in dict.fromkeys((f"v_{self.output}", f"v_{self.turns}")):
                    if speed in values[0]:
                        signed = [p * np.sign(v[speed])[:, None] for p, v in zip(product, values, strict=True)]
                        found[f"sign({speed}) * {label}"] = signed
        return found


def list_dependences(values: Sequence[Values], output: str) -> list[Dependence]:
    """Return the hypotheses of an output: each variable without direction or with each joint's, each pair with its own.

    Predicted forces of other joints are tried alone; the output's own force is tried in pairs with its own variables as well.
    """
    common = [n for n in values[0] if n != WHOLE_TIME and all(n in v for v in values)]
    names = [n for n in common if np.ptp(np.concatenate([v[n] for v in values])) > 0]
    pairs = [p for p in combinations(names, 2) if "t" not in p and _is_force_pair_own(p, output)]
    own = ("", output) if f"v_{output}" in common else ("",)
    every = (*own, *(n[2:] for n in names if n.startswith("v_") and n != f"v_{output}"))
    single = [Dependence(output, (n,), turns) for n in names for turns in every]
    return single + [Dependence(output, p, turns) for p in pairs for turns in own]


def _is_force_pair_own(pair: tuple[str, str], output: str) -> bool:
    """Return whether a pair contains no predicted force, or only variables of the output itself."""
    forces = any(name.startswith("tau_") for name in pair)
    return not forces or all(name.split("_", 1)[-1] == output for name in pair)


MIN_2LOGL_DIFFERENCE = 8.0
"""Difference of penalised statistics (twice the log-likelihood) below which two causes, or two sets of variables, are not
distinguished: odds of 50 to 1."""
_MAX_INDISTINGUISHABLE = 6  # structures that a result names; more do not help
_PAIR_PRICE = 4.0
"""Statistic that a second variable, or another joint's direction, has to add (twice the log-likelihood), beyond the cost of its
columns."""
_CHUNK = 16  # sets of variables tried at once; bounds memory
MIN_LEFT_SHARE = 0.01
"""Least share of a function that the baseline must leave: the functions are not filtered as the baseline's columns are."""
_SIMPLE = 0.85
"""Share of the structure that one term must explain to be suggested as its formula."""


class _StructureCandidate(NamedTuple):
    """Statistic of smooth functions of some variables on an output's residual."""

    penalised_statistic: float
    on: Dependence
    statistic: float
    dof: int


@dataclass(frozen=True, eq=False)
class Structure:
    """Dependence of one output's residual on some variables.

    Attributes:
        on: The output, the variables, and whose direction of motion it follows.
        statistic: Its score statistic, in units of the noise.
        dof: Number of its columns.
        p_value: p-value on clean data, corrected for all sets tried.
        n_effective_tests: Effective number of independent tests in the search over sets.
        penalised_statistic: The statistic minus the cost of its columns, not divided by the scatter of blocks as `T` is.
        share: Its share of the output's residual variance.
        columns: Its columns (n, m, k) of each run.
        formula: A simple expression, or empty.
        alike: Other sets of variables that explain as much, best first.
    """

    on: Dependence
    statistic: float
    dof: int
    p_value: float
    n_effective_tests: float
    penalised_statistic: float
    share: float
    columns: list[np.ndarray]
    formula: str
    alike: tuple[_StructureCandidate, ...] = ()

    @property
    def output(self) -> str:
        """The output."""
        return self.on.output

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables that it depends on."""
        return self.on.variables


def find_structure(null_model: WhiteResidual, draws: np.ndarray, level: float) -> Structure | None:
    """Return the strongest significant dependence at this family-wise level, or None."""
    shapes, tries = _tried(null_model, draws)
    if not shapes:
        return None
    best = shapes[0]
    if level < 1 and _chance(best, tries, _inflation(null_model, best.on)) >= level:
        return None
    near = [
        s
        for s in shapes[1:]
        if s.on.output == best.on.output and s.penalised_statistic > best.penalised_statistic - MIN_2LOGL_DIFFERENCE
    ]
    return _structure(null_model, best, tries, tuple(near[:_MAX_INDISTINGUISHABLE]))


def list_indistinguishable(null_model: WhiteResidual, structure: Structure) -> list[Structure]:
    """Return the structures that are indistinguishable from a structure on the training data."""
    return [_structure(null_model, shape, structure.n_effective_tests, ()) for shape in structure.alike]


def _structure(
    null_model: WhiteResidual, shape: _StructureCandidate, tries: float, alike: tuple[_StructureCandidate, ...]
) -> Structure:
    k = null_model.measurements.outputs.index(shape.on.output)
    rows = np.flatnonzero(null_model.whiten.index == k)
    inflation = _inflation(null_model, shape.on)
    return Structure(
        shape.on,
        shape.statistic / inflation,
        shape.dof,
        _chance(shape, tries, inflation),
        tries,
        shape.penalised_statistic,
        min(1.0, shape.statistic / max(float(null_model.e[rows] @ null_model.e[rows]), 1e-300)),
        [
            place_columns(b, k, len(null_model.measurements.outputs))
            for b in shape.on.bases(null_model.measurements.variables())
        ],
        _formula(null_model, shape),
        alike,
    )


def _chance(shape: _StructureCandidate, tries: float, inflation: float) -> float:
    """Return the p-value under noise alone, corrected for all sets tried."""
    tail = min(float(stats.chi2.sf(shape.statistic / inflation, shape.dof)), 1 - 1e-16)
    return float(-np.expm1(tries * np.log1p(-tail)))


def _tried(null_model: WhiteResidual, draws: np.ndarray) -> tuple[list[_StructureCandidate], float]:
    """Return all sets of variables, the largest penalised statistic first, and the effective number of independent tests."""
    values = null_model.measurements.variables()
    joined = JoinedVariables(values)
    found: list[_StructureCandidate] = []
    noise_chances = []
    for k, output in enumerate(null_model.measurements.outputs):
        rows = np.flatnonzero(null_model.whiten.index == k)
        both, Q = np.concatenate([null_model.e[rows, None], draws[rows]], axis=1), null_model.Q[rows]
        tried = list_dependences(values, output)
        for start in range(0, len(tried), _CHUNK):
            made = [(on, on.build_columns(joined)) for on in tried[start : start + _CHUNK]]
            for size in sorted({columns.shape[1] for _, columns in made} - {0}):
                alike = [(on, columns) for on, columns in made if columns.shape[1] == size]
                basis = joined.split(np.concatenate([columns for _, columns in alike], axis=1))
                C = _rows(null_model, k, basis).reshape(len(rows), len(alike), size)
                T = compute_statistics_of_rows(C, both, Q, np.zeros(size, bool), MIN_LEFT_SHARE)
                noise_chances.append(stats.chi2.sf(T[:, 1:], size))
                for (on, _), statistic in zip(alike, T[:, 0].tolist(), strict=True):
                    merit = statistic - 2 * size - _PAIR_PRICE * on.further
                    found.append(_StructureCandidate(merit, on, statistic, size))
    if not found:
        return [], 1.0
    smallest = np.clip(np.min(np.concatenate(noise_chances), axis=0), 1e-12, 1 - 1e-12)
    tries = count_effective_tests(smallest, len(smallest))
    return sorted(found, key=lambda shape: -shape.penalised_statistic), tries


def compute_structure_p_value(
    noise: NoiseOnlyBootstrap, null_model: WhiteResidual, structure: Structure, others: Sequence[Effect]
) -> float:
    """Return a structure's p-value by the parametric bootstrap of `noise_only_bootstrap.py`."""
    columns = []
    for clean in noise.channels:
        bases = structure.on.bases(clean.variables())
        columns.append([place_columns(b, clean.outputs.index(structure.output), len(clean.outputs)) for b in bases])
    nonnegative = np.zeros(columns[0][0].shape[-1], bool)
    noise_only_models = noise.fit_null_models(null_model, others)
    tail = compute_artefact_chance(
        structure.statistic, noise_only_models, null_model, columns, nonnegative, MIN_LEFT_SHARE
    )
    return min(1.0, structure.n_effective_tests * tail)


def _rows(null_model: WhiteResidual, output: int, basis: Sequence[np.ndarray]) -> np.ndarray:
    return null_model.whiten.one(output, basis) / null_model.scale


def _inflation(null_model: WhiteResidual, on: Dependence) -> float:
    """Return the scatter of blocks over their variance under the noise model, at least 1."""
    k = null_model.measurements.outputs.index(on.output)
    rows = np.flatnonzero(null_model.whiten.index == k)
    C = _rows(null_model, k, on.bases(null_model.measurements.variables()))
    left = C - null_model.Q[rows] @ (null_model.Q[rows].T @ C)
    gamma = np.linalg.lstsq(left, null_model.e[rows], rcond=1e-7)[0]
    along = left @ gamma
    return compute_overdispersion(
        null_model.whiten.block[rows], along * (null_model.e[rows] - along), float(along @ along)
    )


def _formula(null_model: WhiteResidual, shape: _StructureCandidate) -> str:
    """Return the single product of simple terms that explains nearly all, or an empty text."""
    k = null_model.measurements.outputs.index(shape.on.output)
    rows = np.flatnonzero(null_model.whiten.index == k)
    best, text = _SIMPLE * shape.statistic, ""
    for label, bases in shape.on.terms(null_model.measurements.variables()).items():
        C = _rows(null_model, k, bases)
        A = null_model.Q[rows].T @ C
        G = float(np.sum(C**2) - np.sum(A**2))
        if G <= MIN_LEFT_SHARE * float(np.sum(C**2)):
            continue
        s = float(C[:, 0] @ null_model.e[rows])
        if s * s / G > best:
            best, text = s * s / G, f"{s / G:.3g} * {label}"
    return text


def place_columns(basis: np.ndarray, output: int, n_outputs: int) -> np.ndarray:
    """Return columns (n, m, k) that act on one output, from functions (n, k)."""
    out = np.zeros((len(basis), n_outputs, basis.shape[1]))
    out[:, output] = basis
    return out
