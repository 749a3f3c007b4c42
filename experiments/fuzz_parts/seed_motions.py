"""Valid tables of motions and points: what is commanded, what was measured on the way, what is added to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fuzz_parts.seeds import columns, csv_of


def reference() -> dict[str, np.ndarray]:
    """Return the columns of a reference file, a row every 10 ms."""
    t = np.arange(30) * 0.01
    return {"t": t, "q_ref_axis": 0.1 * np.sin(t), "v_ref_axis": 0.1 * np.cos(t), "a_ref_axis": -0.1 * np.sin(t)}


def shaken() -> bytes:
    """Return a vibration log: chance through one resonance, 240 samples."""
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal(240), np.zeros(240)
    for k in range(2, 240):
        y[k] = 1.7 * y[k - 1] - 0.9 * y[k - 2] + 0.1 * u[k - 1]
    return csv_of({"t": np.arange(240) * 0.01, "tau_axis": u, "q_axis": y + 0.01 * rng.standard_normal(240)})


def motion() -> bytes:
    """Return a motion as `simulate --motion` takes it."""
    return csv_of({"t": columns()["t"], "q_ref_axis": columns()["q_axis"]})


def at_rest() -> bytes:
    """Return a motion that begins and ends at rest, as a controller may be given it, a row every 10 ms."""
    s, duration = np.linspace(0, 1, 41), 0.4
    q = 10 * s**3 - 15 * s**4 + 6 * s**5
    v, a = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration, (60 * s - 180 * s**2 + 120 * s**3) / duration**2
    return csv_of({"t": s * duration, "q_ref_axis": 0.05 * q, "v_ref_axis": 0.05 * v, "a_ref_axis": 0.05 * a})


def way() -> bytes:
    """Return points on a straight way of the linear axis' tool."""
    x = np.linspace(-0.2, 0.2, 5)
    return csv_of({"x_tool": x, "y_tool": 0 * x, "z_tool": 0 * x})


def guideway() -> bytes:
    """Return measured points of a cart on a guideway, all 50 mm."""
    q = np.linspace(-0.4, 0.4, 17)
    return csv_of({"q_axis": q, "x_tool": 1.0001 * q, "y_tool": 1e-4 * np.sin(5 * q), "z_tool": 1e-4 * q**2 + 0.05})


def correction() -> bytes:
    """Return a correction file of the pendulum."""
    from tau_dyn.control import Correction
    from tau_dyn.control.interface.correction import format_correction_text

    return format_correction_text(Correction(("axis",), 0.01, np.zeros((30, 1)) + 1e-4, "0123456789abcdef")).encode()


def learned(folder: Path) -> bytes:
    """Return a correction of the motion `at_rest`."""
    from tau_dyn.control import Correction, read_reference
    from tau_dyn.control.interface.correction import format_correction_text
    from tau_dyn.control.interface.reference import compute_digest

    (folder / "seed_rest.csv").write_bytes(at_rest())
    motion = read_reference(folder / "seed_rest.csv", ("axis",), period=0.01)
    added = 1e-4 * np.sin(np.linspace(0, np.pi, motion.n_samples))[:, None] ** 4
    return format_correction_text(Correction(("axis",), 0.01, added, compute_digest(motion))).encode()


def positions() -> bytes:
    """Return robot positions, each with the image taken there."""
    return b"image,q_axis\n" + b"".join(b"img_%03d.png,%.3f\n" % (k, 0.1 * k) for k in range(12))
