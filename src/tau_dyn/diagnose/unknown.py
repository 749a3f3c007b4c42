r"""The unknown unknown: structure in the residual that no named cause explains.

The residual of each output is tried against smooth functions (Legendre, degree 4) of every variable, products (degree 2 by 2)
of every pair, and both times the direction of motion, in the same white rows and against the same noise draws as the
causes. What survives is confirmed like a cause. A formula is the single product of simple terms that explains nearly as much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.encoders import MARGIN, noncentrality
from tau_dyn.diagnose.ground import Ground, gains
from tau_dyn.diagnose.noise import over_runs, smooth
from tau_dyn.diagnose.parts import TRAIN
from tau_dyn.diagnose.trials import PRIOR_BLOCKS

_PAIR_PRICE = 4.0
"""What a second variable has to explain more than one alone, in twice the log-likelihood, beside its degrees of freedom."""
_LEFT = 0.01
"""Part of a function that the baseline must leave: the functions are not filtered as the baseline's columns are."""
_SIMPLE = 0.85
"""Share of the structure that one term must explain to be suggested as its formula."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Dependence of one output's residual on some variables.

    Attributes:
        output: The output.
        variables: What it depends on.
        signed: Whether it follows the direction of motion.
        T: What it explains, in units of the noise.
        p_value: Chance on clean data, all sets tried taken into account.
        tries: Number of independent tries that the search over sets amounts to.
        merit: What it explains less the price of its freedom, not divided by the scatter of blocks as `T` is.
        share: Its part of the output's residual variance.
        columns: Its columns (n, m, k) of each run.
        formula: A simple expression, or empty.
    """

    output: str
    variables: tuple[str, ...]
    signed: bool
    T: float
    p_value: float
    tries: float
    merit: float
    share: float
    columns: list[np.ndarray]
    formula: str


class _Shape(NamedTuple):
    """The variables that one output's residual is tried against, and what smooth functions of them explain."""

    merit: float
    output: str
    variables: tuple[str, ...]
    signed: bool
    T: float
    dof: int


def find_structure(channel: Channel, ground: Ground, draws: np.ndarray, level: float) -> Structure | None:
    """Return the strongest dependence that noise does not explain at this family-wise level, or None."""
    found = _strongest(channel, ground, draws)
    if found is None:
        return None
    best, tries = found
    bases = _bases(channel.variables(), best.variables, best.signed, best.output)
    inflation = _inflation(channel, ground, best.output, bases)
    p_value = float(-np.expm1(tries * np.log1p(-min(float(stats.chi2.sf(best.T / inflation, best.dof)), 1 - 1e-16))))
    if p_value >= level and level < 1:
        return None
    k = channel.outputs.index(best.output)
    rows = np.flatnonzero(ground.whiten.index == k)
    return Structure(
        best.output,
        best.variables,
        best.signed,
        best.T / inflation,
        p_value,
        tries,
        best.merit,
        min(1.0, best.T / max(float(ground.e[rows] @ ground.e[rows]), 1e-300)),
        [_placed(b, k, len(channel.outputs)) for b in bases],
        _formula(channel, ground, best),
    )


def _strongest(channel: Channel, ground: Ground, draws: np.ndarray) -> tuple[_Shape, float] | None:
    """Return the set of variables with the largest merit, and how many independent tries the search over sets amounts to."""
    values = channel.variables()
    best: _Shape | None = None
    noise_chances = []
    for k, output in enumerate(channel.outputs):
        rows = np.flatnonzero(ground.whiten.index == k)
        both = np.concatenate([ground.e[rows, None], draws[rows]], axis=1)
        Q = ground.Q[rows]
        for names, signed in _sets(values, output):
            C = _rows(ground, k, _bases(values, names, signed, output))
            if C.shape[1] == 0:
                continue
            A = Q.T @ C
            G, raw = C.T @ C - A.T @ A, np.sum(C**2, axis=0)
            T = gains((C.T @ both)[None], G[None], raw[None], np.zeros(C.shape[1], bool), _LEFT)[0]
            noise_chances.append(stats.chi2.sf(T[1:], C.shape[1]))
            merit = T[0] - 2 * C.shape[1] - _PAIR_PRICE * (len(names) - 1)
            if best is None or merit > best.merit:
                best = _Shape(merit, output, names, signed, float(T[0]), C.shape[1])
    if best is None:
        return None
    smallest = np.min(noise_chances, axis=0)
    return best, max(1.0, -len(smallest) / float(np.sum(np.log1p(-np.clip(smallest, 1e-12, 1 - 1e-12)))))


def structure_chance(
    cleans: Sequence[Channel], ground: Ground, structure: Structure, others: Sequence[Sequence[list[np.ndarray]]]
) -> float:
    """Return a structure's chance when encoder noise does to it what it does to noise-only logs (see `encoders.py`)."""
    blanks = [Ground.of(c, (TRAIN,), ground.noise, x) for c, x in zip(cleans, others, strict=True)]
    columns = []
    for clean in cleans:
        bases = _bases(clean.variables(), structure.variables, structure.signed, structure.output)
        columns.append([_placed(b, clean.outputs.index(structure.output), len(clean.outputs)) for b in bases])
    dof = columns[0][0].shape[-1]
    bias = MARGIN * noncentrality(blanks, ground, columns, np.zeros(dof, bool), _LEFT)
    tail = stats.ncx2.sf(structure.T, dof, bias) if bias > 0 else stats.chi2.sf(structure.T, dof)
    return min(1.0, structure.tries * float(tail))


def _sets(variables: Sequence[Mapping[str, np.ndarray]], output: str) -> list[tuple[tuple[str, ...], bool]]:
    """Return the sets of variables to try, each with and without the direction of motion."""
    common = [n for n in variables[0] if all(n in v for v in variables)]
    names = [n for n in common if np.ptp(np.concatenate([v[n] for v in variables])) > 0]
    pairs = [p for p in combinations(names, 2) if "t" not in p]
    signs = (False, True) if f"v_{output}" in common else (False,)
    return [(s, signed) for s in [*((n,) for n in names), *pairs] for signed in signs]


def _bases(
    variables: Sequence[Mapping[str, np.ndarray]], names: tuple[str, ...], signed: bool, output: str
) -> list[np.ndarray]:
    """Return smooth columns (n, k) of one variable, or of a pair, of each run."""
    return over_runs(variables, lambda joined: _basis(joined, names, signed, output))


def _basis(values: Mapping[str, np.ndarray], names: tuple[str, ...], signed: bool, output: str) -> np.ndarray:
    """Return smooth columns (n, k) of one variable, or of a pair."""
    if len(names) == 1:
        columns = smooth(values[names[0]])
    else:
        one, other = (smooth(values[n], 2) for n in names)
        columns = [a * b for a in one for b in other]
    sign = np.sign(values[f"v_{output}"]) if signed else 1.0
    return np.column_stack([sign * c for c in columns]) if columns else np.zeros((len(next(iter(values.values()))), 0))


def _rows(ground: Ground, output: int, basis: Sequence[np.ndarray]) -> np.ndarray:
    return ground.whiten.one(output, basis) / ground.scale


def _inflation(channel: Channel, ground: Ground, output: str, bases: Sequence[np.ndarray]) -> float:
    """Return the scatter of blocks over what the noise model says, at least 1."""
    k = channel.outputs.index(output)
    rows = np.flatnonzero(ground.whiten.index == k)
    C = _rows(ground, k, bases)
    left = C - ground.Q[rows] @ (ground.Q[rows].T @ C)
    gamma = np.linalg.lstsq(left, ground.e[rows], rcond=1e-7)[0]
    along = left @ gamma
    square = float(along @ along)
    if square <= 0:
        return 1.0
    scores = np.bincount(ground.whiten.block[rows], along * (ground.e[rows] - along))
    count = len(np.unique(ground.whiten.block[rows]))
    return max(1.0, (count * float(np.sum(scores**2)) / square + PRIOR_BLOCKS) / (count + PRIOR_BLOCKS))


def _formula(channel: Channel, ground: Ground, shape: _Shape) -> str:
    """Return the one product of simple terms that explains nearly all, or an empty text."""
    k = channel.outputs.index(shape.output)
    rows = np.flatnonzero(ground.whiten.index == k)
    best, text = _SIMPLE * shape.T, ""
    for label, bases in _terms(channel.variables(), shape.variables, shape.output).items():
        C = _rows(ground, k, bases)
        A = ground.Q[rows].T @ C
        G = float(np.sum(C**2) - np.sum(A**2))
        if G <= _LEFT * float(np.sum(C**2)):
            continue
        s = float(C[:, 0] @ ground.e[rows])
        if s * s / G > best:
            best, text = s * s / G, f"{s / G:.3g} * {label}"
    return text


def _terms(
    values: Sequence[Mapping[str, np.ndarray]], names: tuple[str, ...], output: str
) -> dict[str, list[np.ndarray]]:
    """Return simple products (n, 1) of each run by what they are called."""
    shapes = {
        "{}": lambda x: x,
        "{}^2": lambda x: x**2,
        "{}^3": lambda x: x**3,
        "|{}|": np.abs,
        "{0} |{0}|": lambda x: x * np.abs(x),
        "sign({})": np.sign,
    }
    found: dict[str, list[np.ndarray]] = {}
    for first, f in shapes.items():
        seconds = shapes.items() if len(names) == 2 else [("", lambda x: np.ones_like(x))]
        for second, g in seconds:
            label = " * ".join(x for x in (first.format(names[0]), second.format(names[-1])) if x)
            product = [(f(v[names[0]]) * g(v[names[-1]]))[:, None] for v in values]
            found[label] = product
            if f"v_{output}" in values[0]:
                signed = [p * np.sign(v[f"v_{output}"])[:, None] for p, v in zip(product, values, strict=True)]
                found[f"sign(v_{output}) * {label}"] = signed
    return found


def _placed(basis: np.ndarray, output: int, n_outputs: int) -> np.ndarray:
    out = np.zeros((len(basis), n_outputs, basis.shape[1]))
    out[:, output] = basis
    return out
