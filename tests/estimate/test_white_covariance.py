"""How certain whitened equations make an estimate, and that whiteness is not taken on trust."""

import numpy as np
from scipy.signal import lfilter

from tau_dyn.estimate.covariance import estimate_score_covariance

N, DT = 8000, 0.002


def middles(colour: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both middles and the score itself, of two slow columns and noise with an AR(1) memory."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(N)
    Z = np.stack([np.ones(N), np.sin(2 * np.pi * 0.5 * t)], axis=1)[:, None, :]
    e = lfilter([np.sqrt(1 - colour**2)], [1, -colour], rng.normal(size=(N, 1)), axis=0)
    keep = np.ones((N, 1), bool)
    coloured, scattered = estimate_score_covariance([t], [Z], [e], [keep])
    return coloured, scattered, np.einsum("nmr,nm->r", Z, e)


def test_white_residuals_give_the_classical_covariance():
    """`sum of Z' Z` at unit variance, to the 2 % that 8000 samples tell."""
    coloured, _, _ = middles(0.0, 0)
    assert np.allclose(np.diag(coloured), [N, N / 2], rtol=0.05)


def test_memory_is_seen_by_both():
    """With AR(1) 0.8 a score scatters three times as much as white noise would make it; both middles say so."""
    found = [middles(0.8, seed) for seed in range(40)]
    true = np.mean([s**2 for *_, s in found], axis=0)
    assert np.all(true > 5 * np.array([N, N / 2]))
    for k in (0, 1):
        said = np.mean([np.diag(x[k]) for x in found], axis=0)
        assert np.all(np.abs(np.log(said / true)) < np.log(1.8))


def test_blocks_are_a_tenth_of_a_second_and_two_seconds_long():
    """A residual of one throughout: every block's score is its number of samples, B blocks scatter by `B n^2 B / (B - 1)`."""
    t, one = DT * np.arange(N), np.ones((N, 1))
    coloured, scattered = estimate_score_covariance([t], [one[:, :, None]], [one], [np.ones((N, 1), bool)])
    for found, seconds, free in ((coloured, 0.1, 1 - 1 / N), (scattered, 2.0, 1.0)):
        size = seconds / DT
        blocks = N / size
        assert np.allclose(found * free, blocks * size**2 * blocks / (blocks - 1), rtol=1e-9)
