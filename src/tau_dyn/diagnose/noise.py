"""The noise of each output, judged on what a rich model leaves.

Were it judged on the baseline's residual, a hidden effect would count as noise. So every output may depend smoothly on all
variables of its own joint, times the direction of motion, and ring at the frequencies that a black-box fit proposes (an
autoregressive model would otherwise take a resonance for the noise's colour); such a model is fitted to what is then left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.polynomial import legendre

from tau_dyn.diagnose.channel import Channel
from tau_dyn.estimate import Autoregression, fit_autoregression, solve_scaled
from tau_dyn.log import find_true_runs

WHOLE_TIME = "t_whole"
"""Time through all logs, one after the other, where there are several: what settles may go on in the next one, or begin anew."""
_DEGREE = 4  # of the smooth functions of a variable
_MAX_ORDER = 8  # of the autoregressive model of the residual, selected below it


def fit_noise_models(
    channel: Channel, parts: Sequence[int], extra: Sequence[Sequence[np.ndarray]] = ()
) -> tuple[Autoregression, ...]:
    """Return the noise model of each output, from samples of these parts, further columns (n, m, k) accounted for."""
    masks = channel.masks(*parts)
    variables = channel.variables()
    models = []
    for k, output in enumerate(channel.outputs):
        rich = build_smooth_columns(variables, output)
        columns = [
            np.concatenate(
                [c[r][:, k] for c in (channel.free_columns, channel.resonance_columns, *extra)] + [rich[r]], axis=1
            )
            for r in range(len(channel.runs))
        ]
        rows = np.concatenate([x[m[:, k]] for x, m in zip(columns, masks, strict=True)])
        y = np.concatenate([x[m[:, k], k] for x, m in zip(channel.target, masks, strict=True)])
        theta = solve_scaled(rows, y, 1e-7)
        stretches = []
        for x, y_run, mask in zip(columns, channel.target, masks, strict=True):
            e = y_run[:, k] - x @ theta
            stretches += [e[s] for s in find_true_runs(mask[:, k])]
        still = Autoregression(np.zeros(0), 1.0)  # an output without a usable sample has no rows to whiten
        models.append(fit_autoregression(stretches, _MAX_ORDER) if stretches else still)
    return tuple(models)


def build_smooth_columns(variables: Sequence[Mapping[str, np.ndarray]], output: str) -> list[np.ndarray]:
    """Return smooth functions (n, c) of an output's own variables, and the same times the direction of motion, of each run."""
    return build_joined_columns(variables, lambda joined: _rich(joined, output))


def build_joined_columns(
    variables: Sequence[Mapping[str, np.ndarray]], columns: Callable[[Mapping[str, np.ndarray]], np.ndarray]
) -> list[np.ndarray]:
    """Return columns (n, c) of each run, made of all runs' variables joined: one function, whatever range a run covers."""
    common = [name for name in variables[0] if all(name in v for v in variables)]
    joined = {name: np.concatenate([v[name] for v in variables]) for name in common}
    lengths = [len(next(iter(v.values()))) for v in variables]
    return np.split(columns(joined), np.cumsum(lengths)[:-1])


def _rich(variables: Mapping[str, np.ndarray], output: str) -> np.ndarray:
    own = [x for name, x in variables.items() if name.split("_", 1)[-1] == output or name in ("t", WHOLE_TIME)]
    sign = np.sign(variables.get(f"v_{output}", np.zeros(1)))
    basis = [c for x in own for c in smooth(x)]
    basis += [sign * c for c in basis] if np.any(sign) else []
    return np.column_stack(basis)


def smooth(x: np.ndarray, degree: int = _DEGREE) -> list[np.ndarray]:
    """Return Legendre polynomials of degree 1 to `degree` of a variable (n,) scaled to its range; none if constant."""
    low, high = float(x.min()), float(x.max())
    if not high > low:
        return []
    scaled = 2 * (x - low) / (high - low) - 1
    return list(legendre.legvander(scaled, degree).T[1:])
