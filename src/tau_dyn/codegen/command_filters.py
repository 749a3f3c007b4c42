"""Input shapers and notch filters as C99, a sample at a time: `name_start` at rest, then `name_step` for each sample.

A shaper is a delay line with a few taps, `y_t = sum_i A_i x_{t - k_i}`; a notch a chain of second-order sections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from tau_dyn.codegen.c_writer import (
    MAX_NUMBER,
    fill_template,
    format_header,
    format_source,
    format_table,
    require_c_name,
)
from tau_dyn.codegen.filters import pad_to_third_order
from tau_dyn.exceptions import InputError
from tau_dyn.version import __version__


class SampledShaper(Protocol):
    """Impulses at whole samples, as `control.vibration.Shaper.sampled` returns them."""

    @property
    def times(self) -> np.ndarray:
        """When (n,) [s]."""
        ...

    @property
    def amplitudes(self) -> np.ndarray:
        """How large (n,)."""
        ...


class Sections(Protocol):
    """A chain of second-order sections (s, 6) for a step [s], as `control.vibration.CausalNotch`."""

    @property
    def sections(self) -> np.ndarray:
        """Second-order sections (s, 6), b then a."""
        ...

    @property
    def dt(self) -> float:
        """Sampling step [s]."""
        ...


def write_shaper_source(
    shaper: SampledShaper, dt: float, name: str = "shaper", words: Sequence[str] = ()
) -> tuple[str, str]:
    """Return a shaper as C: the source and its header.

    Args:
        shaper: Impulses at whole samples.
        dt: Sampling step [s].
        name: Prefix of all functions, and name of the header, `name.h`.
        words: Lines for the header: the modes and their residual vibration.

    Raises:
        InputError: The name is no identifier of C, or an impulse is between two samples.
    """
    require_c_name(name)
    delays = np.round(shaper.times / dt).astype(int)
    if np.abs(delays * dt - shaper.times).max() > 1e-6 * dt:
        raise InputError("invalid_value", f"impulses lie between samples of {dt:g} s; sample the shaper first")
    first = f"Input shaper of {len(delays)} impulses, written by tau-dyn {__version__}."
    size = max(int(delays[-1]), 1)
    parts = [
        f"enum {{ N = {size}, TAPS = {len(delays)} }};",
        format_table("int", "delay", delays.tolist(), "TAPS"),
        format_table("double", "amplitude", shaper.amplitudes, "TAPS"),
        fill_template("checks"),
        fill_template("shaper", NAME=name),
    ]
    said = [first, f"Sampling step {dt!r} s; it makes a command {delays[-1]} samples longer.", *words, "", *_WORDS]
    return format_source(name, first, parts), format_header(name, said, _declare(name, size))


def write_notch_source(notch: Sections, name: str = "notch", words: Sequence[str] = ()) -> tuple[str, str]:
    """Return a chain of second-order sections with a gain of one at rest as C: the source and its header.

    Args:
        notch: The filter.
        name: Prefix of all functions, and name of the header, `name.h`.
        words: Lines for the header: the modes and their residual vibration.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    first = f"Notch filter of {len(notch.sections)} sections, written by tau-dyn {__version__}."
    rows = [pad_to_third_order(row[:3], row[3:]) for row in notch.sections]
    parts = [
        f"enum {{ M = {len(rows)} }};",
        format_table("double", "filters", np.ravel(rows), "8 * M"),
        fill_template("checks"),
        fill_template("one_step"),
        fill_template("notch", NAME=name),
    ]
    said = [first, f"Sampling step {notch.dt!r} s.", *words, "", *_WORDS]
    return format_source(name, first, parts), format_header(name, said, _declare(name, 3 * len(rows) + 1))


def _declare(name: str, size: int) -> list[str]:
    state = f"double state[{name.upper()}_STATE]"
    return [
        f"#define {name.upper()}_STATE {size}",
        f"void {name}_start({state}, double x);",
        f"int {name}_step({state}, double x, double *y);",
    ]


_WORDS = (
    "start: the signal rests at x. step: one call a sample, in order.",
    f"step returns 0; or 1 where x, the state or y is no number, or beyond {MAX_NUMBER:g}; then state and y are left alone.",
    "Compile without -ffast-math, which takes this check away. No allocation, no state but the caller's.",
)
