"""Every number of the study beside the thesis' (empty where the thesis has none)."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from tau_dyn.modes import Mode
from thesis_6_3_parts import printed
from thesis_6_3_parts.black_box import BlackBox
from thesis_6_3_parts.drives import DT, DriveStudy
from thesis_6_3_parts.pushes import PushStudy
from thesis_6_3_parts.robots import with_wrist, without_wrist
from thesis_6_3_parts.wristless import WristlessStudy

Row = tuple[str, str, float, str, str]


def tables(table: PushStudy, models: list[BlackBox], bare: WristlessStudy) -> dict[str, pd.DataFrame]:
    """Return the tables by file name."""
    rows = [
        {"force": force, "output": output, "push": k, "whole_hz": w, "early_hz": e, "late_hz": late}
        for (force, output), whole in table.whole.items()
        for k, (w, e, late) in enumerate(zip(whole, table.early[force, output], table.late[force, output], strict=True))
    ]
    found = [(f"{m.name} {m.experiment}", m.modes) for m in models]
    found += [("12th order, pushes", bare.full.refined.modes), ("4th order, x and y", bare.two.refined.modes)]
    found += [(f"cart 3, order {order}", modes) for order, (modes, _) in bare.cart3.items()]
    return {"table_6_4": pd.DataFrame(rows), "modes": pd.DataFrame([r for name, m in found for r in _modes(name, m)])}


def summary(drives: DriveStudy, table: PushStudy, models: list[BlackBox], bare: WristlessStudy) -> pd.DataFrame:
    """Return where, what, ours, the thesis' and the unit, one row a number."""
    rows = [*_springs(), *_drives(drives), *_pushes(table), *_models(models), *_bare(bare), *_structure(bare)]
    return pd.DataFrame(rows, columns=["where", "what", "ours", "thesis", "unit"])


def _modes(name: str, modes: Sequence[Mode]) -> Iterator[dict]:
    for mode in modes:
        yield {
            "model": name,
            "frequency_hz": mode.frequency_hz,
            "frequency_stderr": mode.frequency_stderr,
            "damping_ratio": mode.damping_ratio,
            "damping_stderr": mode.damping_stderr,
        }


def _nearest(frequencies: np.ndarray, wanted: float) -> float:
    return float(frequencies[np.argmin(np.abs(frequencies - wanted))])


def _springs() -> Iterator[Row]:
    bare, wrist = without_wrist().natural_frequencies(), with_wrist().natural_frequencies()
    for f in printed.WITHOUT_WRIST:
        yield "the springs", f"mode without wrist, nearest to {f:g} Hz", _nearest(bare, f), f"{f:g}", "Hz"
    for f, text in ((7.4, "7.4"), (11.45, "11.4-11.5")):
        yield "the springs", f"mode with wrist, nearest to {f:g} Hz", _nearest(wrist, f), text, "Hz"
    yield "the springs", "springs", len(wrist), "45 expected", ""


def _drives(drives: DriveStudy) -> Iterator[Row]:
    for (cart, (b, a)), fit, percent in zip(printed.DRIVES.items(), drives.fits, drives.fit_percent, strict=True):
        numerator, pole, samples = fit.actuator.discrete(DT)
        yield "(6.11)", f"{cart} pole", pole, f"{a:g}", ""
        yield "(6.11)", f"{cart} numerator", float(numerator.sum()), f"{b:g}", ""
        yield "(6.11)", f"{cart} delay", fit.actuator.delay / DT + 1, f"{printed.DRIVE_SAMPLES}", "samples"
        yield "(6.11)", f"{cart} bandwidth", fit.actuator.bandwidth_hz, f"about {printed.DRIVE_BANDWIDTH_HZ:g}", "Hz"
        yield "Figure 6.9", f"{cart} fit, held out", percent, "good", "%"


def _range(values: tuple[float, float]) -> str:
    return f"{values[0]:g}" if values[0] == values[1] else f"{values[0]:g}-{values[1]:g}"


def _pushes(table: PushStudy) -> Iterator[Row]:
    for (force, output), values in table.whole.items():
        what = f"pushed along {force}, seen in {output}"
        yield "Table 6.4", what, float(np.median(values)), _range(printed.TABLE_6_4[force, output]), "Hz"
    yield "Table 6.4", "pushed along x, y at first", float(np.median(table.early["x", "y"])), "11.4-11.9", "Hz"
    yield "Table 6.4", "pushed along x, y later", float(np.median(table.late["x", "y"])), "7.3-7.5", "Hz"


def _models(models: list[BlackBox]) -> Iterator[Row]:
    for m in models:
        where, what = m.name, f"order {m.model.order}, {m.experiment}"
        thesis = {"(6.12)": "order 7", "(6.13)": "order 10"}.get(m.name, "")
        for axis, fit in zip("xy", m.fit, strict=True):
            yield where, f"{what}: fit of {axis}, held out", float(fit), thesis, "%"
        for mode in m.modes:
            if mode.frequency_hz < 30:
                yield where, f"{what}: mode", mode.frequency_hz, "around 10", "Hz"


def _bare(bare: WristlessStudy) -> Iterator[Row]:
    for axis, fit in zip("xyz", bare.full.fit, strict=True):
        yield "Figure 6.13", f"12th order, fit of {axis}, held out", float(fit), "", "%"
    for mode in bare.full.refined.modes:
        yield "Figure 6.11", "12th order, mode", mode.frequency_hz, "close together around 16", "Hz"
    for order, (modes, fit) in bare.cart3.items():
        for mode in modes:
            yield "cart 3 alone", f"order {order}, mode", mode.frequency_hz, "14" if order == 4 else "", "Hz"
        yield "cart 3 alone", f"order {order}, mean fit", float(np.mean(fit)), "", "%"


def _structure(bare: WristlessStudy) -> Iterator[Row]:
    """Characters of matrices: printed, ours by the thesis' route, ours."""
    cases = [("printed matrices", bare.printed)]
    cases += [(f"thesis' route, {axes}", pair.character) for axes, pair in bare.pairs.items()]
    for name, c in cases:
        for k, value in enumerate(c.undamped_hz):
            yield name, f"|lambda| of M lambda + K, {k + 1}", float(value), ("14", "103")[k] if k < 2 else "", "Hz"
        yield name, "largest real part of lambda", float(np.max(c.undamped_roots.real)), "", "1/s^2"
        yield name, "unstable poles with D", float(c.n_unstable), "", ""
        for matrix, skew, low in zip("MDK", c.asymmetry, c.lowest, strict=True):
            yield name, f"{matrix}: skew part", float(skew), "", ""
            yield name, f"{matrix}: least eigenvalue of the symmetric part, over the norm", float(low), "", ""
    for axes, pair in bare.pairs.items():
        D = pair.by_thesis.D
        yield f"thesis' route, {axes}", "trace of D", float(np.trace(D)), "positive", "N s/m"
        yield f"thesis' route, {axes}", "determinant of D", float(np.linalg.det(D)), "negative", "(N s/m)^2"
    ways = [(f"ours, {axes}", pair.ours) for axes, pair in bare.pairs.items()] + [("ours, xyz", bare.ours_full)]
    for name, ours in ways:
        yield name, f"status {ours.status}: {ours.why}", np.nan, "", ""
        if ours.valid_hz is not None:
            yield name, "valid from", ours.valid_hz[0], "", "Hz"
            yield name, "valid to", ours.valid_hz[1], "", "Hz"
        still = ours.static_compliance
        if still is not None:
            kept = ["xyz".index(axis) for axis in name.removeprefix("ours, ")]
            truth = bare.compliance[np.ix_(kept, kept)]
            worst = float(np.linalg.norm(still - truth) / np.linalg.norm(truth))
            yield name, "static compliance, error", 100 * worst, "", "%"
