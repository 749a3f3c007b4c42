"""What a force without a name may depend on: one variable or two, and perhaps the direction in which a joint moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from tau_dyn.diagnose.noise import WHOLE_TIME, build_joined_columns, smooth

Values = Mapping[str, np.ndarray]
"""Variable -> its values (n,) in one run, such as `v_cart1` or `t`."""

_SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "{}": lambda x: x,
    "{}^2": lambda x: x**2,
    "{}^3": lambda x: x**3,
    "|{}|": np.abs,
    "{0} |{0}|": lambda x: x * np.abs(x),
    "sign({})": np.sign,
}


class Dependence(NamedTuple):
    """A force at `output` as a smooth function of `names`, times the direction of motion of joint `turns`, if one is named."""

    output: str
    names: tuple[str, ...]
    turns: str = ""

    @property
    def variables(self) -> tuple[str, ...]:
        """All that it depends on; on a direction of motion as on the speed whose sign it is."""
        speed = f"v_{self.turns}"
        return self.names if not self.turns or speed in self.names else (*self.names, speed)

    @property
    def further(self) -> int:
        """Number of things it depends on beyond one variable and the output's own direction."""
        return len(self.names) - 1 + (self.turns not in ("", self.output))

    def bases(self, values: Sequence[Values]) -> list[np.ndarray]:
        """Return smooth columns (n, k) of each run: Legendre, degree 4, or 2 by 2 of a pair."""
        return build_joined_columns(values, self._basis)

    def _basis(self, values: Values) -> np.ndarray:
        if len(self.names) == 1:
            columns = smooth(values[self.names[0]])
            if self.names == ("t",) and WHOLE_TIME in values:
                columns += smooth(values[WHOLE_TIME])
        else:
            one, other = (smooth(values[n], 2) for n in self.names)
            columns = [a * b for a in one for b in other]
        sign = np.sign(values[f"v_{self.turns}"]) if self.turns else 1.0
        return (
            np.column_stack([sign * c for c in columns]) if columns else np.zeros((len(next(iter(values.values()))), 0))
        )

    def terms(self, values: Sequence[Values]) -> dict[str, list[np.ndarray]]:
        """Return simple products (n, 1) of each run by what they are called."""
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
    """Return what an output is tried against: each variable with every joint's direction or none, each pair with its own."""
    common = [n for n in values[0] if n != WHOLE_TIME and all(n in v for v in values)]
    names = [n for n in common if np.ptp(np.concatenate([v[n] for v in values])) > 0]
    pairs = [p for p in combinations(names, 2) if "t" not in p]
    own = ("", output) if f"v_{output}" in common else ("",)
    every = (*own, *(n[2:] for n in names if n.startswith("v_") and n != f"v_{output}"))
    single = [Dependence(output, (n,), turns) for n in names for turns in every]
    return single + [Dependence(output, p, turns) for p in pairs for turns in own]
