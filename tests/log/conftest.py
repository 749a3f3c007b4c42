"""A motion of one axis, and files made from it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.log import Log

RATE = 1000.0


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240611)


@pytest.fixture
def motion() -> Callable[..., np.ndarray]:
    """Return positions (N,) [m] of a stroke with two slow waves and a fast one, evaluated at any times [s]."""

    def position(t: np.ndarray) -> np.ndarray:
        slow = 0.3 * np.sin(np.pi * t) + 0.1 * np.sin(2 * np.pi * 1.7 * t + 0.3)
        return slow + 0.01 * np.sin(2 * np.pi * 8 * t)

    return position


@pytest.fixture
def axis_log(motion, rng) -> Log:
    """A good log: 20 s at 1 kHz, 5 um of encoder noise, force of a 10 kg mass with friction, reference 5 ms ahead."""
    t = np.arange(20000) / RATE
    q = motion(t)
    v = np.gradient(q, 1 / RATE)
    tau = 10 * np.gradient(v, 1 / RATE) + 20 * np.sign(v) + rng.standard_normal(t.size)
    noisy = q + 5e-6 * rng.standard_normal(t.size)
    return Log(t, {"q_axis": noisy, "q_ref_axis": motion(t + 0.005), "tau_axis": tau}, name="good.csv")


@pytest.fixture
def csv_file(tmp_path) -> Callable[..., Path]:
    """Return a writer of a file from its lines; 20 good lines can be had with `good_lines`."""

    def write(lines: list[str] | str | bytes, name: str = "monday.csv", end: str = "\n", newline: str = "\n") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        content = lines if isinstance(lines, str | bytes) else newline.join(lines) + end
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture
def good_lines() -> list[str]:
    """A header and 20 samples of one axis: header in line 1, sample k in line k + 2."""
    return ["t,q_axis,tau_axis", *(f"{0.004 * k:.3f},{0.1 * k:.4f},{5 - k:.3f}" for k in range(20))]
