r"""How strongly a hidden effect shows: lambda, and what an oracle that knows its shape would make of it.

    lambda = |P r|^2,   r = (force without noise - base model) made white,   P = projection off the base model's white columns,

over the training samples at which the joint moves faster than 1 % of its top speed, but for soft edges of 40 ms; the base
model is refitted, which is what P does. An F test on the true shape has this noncentrality. White means divided, frequency by
frequency up to 80 Hz, by the spectrum of everything random in the equation of motion:

    S_j(w) = S_force(w) + sum_k s_k^2 |M_jk w^2 + B_jk i w|^2,

force noise of its true colour and white encoder noise `s` twice differentiated through the mean inertia M, and through the
viscous friction B; forces alone would count an effect at frequencies where 5 um of encoder noise bury it (above 17 Hz on 90 kg).
Masked samples are set to zero on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, rfft, rfftfreq
from scipy.ndimage import binary_dilation, convolve1d

from hidden_effects_parts.recording import Recording, Sensing

SLOW = 0.01
"""Share of the top speed below which samples do not count."""

EDGE_S = 0.02
"""Half-length of the soft edges beside slow samples [s]."""

HIGHEST_HZ = 80.0
"""Frequencies above it do not count [Hz]; what hides is mostly slower, and encoder noise buries the rest."""


@dataclass(frozen=True, eq=False)
class Whitener:
    """Divides by the noise's spectrum, joint by joint; sums of squares of its rows are in standard deviations."""

    inverse: np.ndarray  # (frequencies, na)
    mask: np.ndarray  # (N, na)
    length: int

    @classmethod
    def of(cls, run: Recording, sensing: Sensing, *, encoder: bool = True) -> Whitener:
        """Return the whitener of one run; without `encoder` only force noise counts."""
        n, na = run.tau.shape
        length = int(next_fast_len(n, real=True) or n)  # motions end where they start, at rest
        w = 2 * np.pi * rfftfreq(length, 1 / sensing.rate_hz)
        w = w[w < 2 * np.pi * HIGHEST_HZ]
        c = sensing.colour
        turn = np.exp(-1j * w / sensing.rate_hz)
        spectrum = np.repeat((sensing.force**2 * (1 - c**2) / np.abs(1 - c * turn) ** 2)[:, None], na, axis=1)
        if encoder:
            inertia = run.rig.inertia(run.q[:: max(1, n // 60)])
            size = np.sqrt(np.mean(inertia**2, axis=0))
            drag = np.diag(run.rig.friction.viscous)
            response = size * (w**2)[:, None, None] + 1j * drag * w[:, None, None]
            spectrum += sensing.position_sd**2 * np.sum(np.abs(response) ** 2, axis=2)
        # one-sided sums count twice, so that squares of the rows add up as they do in time
        weight = np.full(len(w), 2.0 / length)
        weight[0] = 1.0 / length
        return cls(np.sqrt(weight[:, None] / spectrum), _mask(run, sensing.rate_hz), length)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return white rows (rows, p) of columns (N, na, p)."""
        n, na, p = x.shape
        rows = np.zeros((na, len(self.inverse), p), complex)
        for k in range(na):
            touching = np.any(x[:, k], axis=0)
            if touching.any():
                held = (x[:, k, touching] * self.mask[:, k, None]).T
                spectra = np.asarray(rfft(held, self.length))[:, : len(self.inverse)]
                rows[k][:, touching] = (spectra * self.inverse[:, k]).T
        flat = rows.reshape(-1, p)
        return np.concatenate([flat.real, flat.imag])


@dataclass(frozen=True, eq=False)
class Ruler:
    """Measures misfits of one set of runs against a base model and perhaps further columns.

    Attributes:
        whiteners: One a run.
        basis: Orthonormal basis of the white base columns (rows, r).
        share: Part of the data that is trained on.
    """

    whiteners: tuple[Whitener, ...]
    basis: np.ndarray
    share: float

    @classmethod
    def of(
        cls,
        runs: Sequence[Recording],
        columns: Sequence[np.ndarray],
        sensing: Sensing,
        share: float,
        further: Sequence[np.ndarray] = (),
        *,
        encoder: bool = True,
    ) -> Ruler:
        """Return the ruler of runs.

        Args:
            runs: Training runs before noise.
            columns: Their base columns, as `base_columns` gives them.
            sensing: Their sensors.
            share: Part of the data that is trained on.
            further: Forces (N, na), one a run, that count as known up to a factor.
            encoder: Whether encoder noise counts.
        """
        whiteners = tuple(Whitener.of(run, sensing, encoder=encoder) for run in runs)
        if further:
            columns = [np.concatenate([w, f[:, :, None]], axis=2) for w, f in zip(columns, further, strict=True)]
        white = np.concatenate([whiten(w) for whiten, w in zip(whiteners, columns, strict=True)])
        return cls(whiteners, orthonormal(white), share)

    def rows(self, forces: Sequence[np.ndarray]) -> np.ndarray:
        """Return the white rows (rows,) of forces (N, na), one a run, off the base columns."""
        y = np.concatenate([whiten(f[:, :, None]) for whiten, f in zip(self.whiteners, forces, strict=True)])[:, 0]
        return y - self.basis @ (self.basis.T @ y)

    def strength(self, forces: Sequence[np.ndarray]) -> float:
        """Return lambda of forces (N, na), one a run."""
        return self.share * float(np.sum(self.rows(forces) ** 2))


def _mask(run: Recording, rate_hz: float) -> np.ndarray:
    """Return 1 where a sample counts and 0 where its joint is slow (N, na), with soft edges: sharp ones spill colour."""
    slow = np.abs(run.v) < SLOW * np.max(np.abs(run.v), axis=0)
    half = int(np.ceil(EDGE_S * rate_hz))
    ramp = np.hanning(2 * half + 3)[1:-1]
    wide = binary_dilation(slow, np.ones((2 * half + 1, 1), bool))
    return 1 - convolve1d(wide.astype(float), ramp / ramp.sum(), axis=0, mode="nearest")


def base_columns(run: Recording) -> np.ndarray:
    """Return the columns (N, na, p) that the person's model may refit on a run."""
    model = run.rig.model
    return model.regressor(run.q, run.v, run.a)[:, :, model.parameters.free]


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (rows, r) of columns (rows, p), dependent ones left out."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns[:, scale > 0] / scale[scale > 0]
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-9 * values[-1]
    return columns @ (vectors[:, kept] / np.sqrt(values[kept]))
