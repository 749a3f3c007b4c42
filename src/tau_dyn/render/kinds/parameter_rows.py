"""The parameter table of an identification and of a diagnosis' extended model: one row per parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tau_dyn import results as r
from tau_dyn.estimate import MAX_RELATIVE_STDERR
from tau_dyn.identify import Identification
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import compute_nominal_stderr, load_robot_from_urdf

_RIGID_BODY = "Rigid body"
State = Literal["known", "weak", "unseen", "fold"]


@dataclass(frozen=True)
class ParameterRow:
    """A parameter in words.

    Attributes:
        name: Contract name.
        group: Heading of its group.
        state: `known` to 30 %, `weak`, `unseen` by itself, or `fold` of several unseen ones.
        estimate: Value ± standard error; the nominal value if it is unseen.
        interval: 95 % interval.
        unit: Its unit.
        nominal: Nominal value; empty if there is no trusted one.
        note: Remark for the reader, or ''.
        bar: Picture of the interval; None without an interval.
        true: The true value of a simulation; empty if it is not known.
        distance: Absolute error in standard errors.
        before: Value in the model without the causes, if there is one for comparison.
        is_told: Whether the data tell more than a sign or the robot file does; a terminal lists no other estimate.
    """

    name: str
    group: str
    state: State
    estimate: str
    interval: str
    unit: str
    nominal: str
    note: str
    bar: r.IntervalBar | None
    true: str = ""
    distance: str = ""
    before: str = ""
    is_told: bool = True


def build_parameter_rows(found: Identification, truth: Mapping[str, float] | None = None) -> list[ParameterRow]:
    """Return the table's rows: those of the rigid body, then those of each joint in the robot's order."""
    raw = found.rows()
    scale = compute_bar_scale(raw)
    rows = [describe_row(entry, scale, name_group(found.model, entry["name"]), _note(found, entry)) for entry in raw]
    rows = [
        _compared(row, entry, truth[row.name]) if truth and row.name in truth else row
        for row, entry in zip(rows, raw, strict=True)
    ]
    return _sort_groups(found.model, rows)


def group_rows(rows: Sequence[ParameterRow]) -> list[tuple[str, list[ParameterRow]]]:
    """Return the rows by heading, headings in the order of their first rows."""
    found: dict[str, list[ParameterRow]] = {}
    for row in rows:
        found.setdefault(row.group, []).append(row)
    return list(found.items())


def build_parameter_table(
    rows: Sequence[ParameterRow], scale: str, *, truth: bool = False, before: bool = False, on: r.On = r.On.PAGE
) -> list[r.Element]:
    """Return the table and its legend.

    A terminal shows only parameters that are identifiable alone and whose standard error is below their own size, their nominal
    value or its standard error. A page shows all, those without an estimate by link.

    Args:
        rows: Its rows.
        scale: Meaning of the ends of a bar.
        truth: Whether the true values are known.
        before: Whether the values of the model without the causes are shown next to those of the extended model.
        on: Output in which the table is shown.
    """
    page, both = r.On.PAGE, r.On.DRAWN
    rows = _fold_unseen(rows)
    nominal = r.On.NOTEBOOK if truth else both if not any(entry.nominal for entry in rows) else r.On.ALL
    columns = [
        r.Column("parameter", on=both),
        r.Column("identifiable alone", on=r.On.TERMINAL),
        r.Column("nominal", "number", "spare", on=nominal),
        *([r.Column("without the causes", "number", "quiet", on=page)] if before else []),
        r.Column("extended model ± standard error" if before else "estimate ±\nstandard error", "number", "strong"),
        r.Column("unit", "unit"),
        *([] if before else [r.Column("95 % interval", "number", "spare", on=both)]),
        r.Column("", "interval", on=both, scale=scale),
        *([r.Column("true", "number"), r.Column("error / standard error", "number", "far", on=page)] if truth else []),
        r.Column("remark", style="remark", on=both),
    ]
    groups = [(title, [_build_row(entry, truth, before) for entry in members]) for title, members in group_rows(rows)]
    reading = (
        "± is one standard error (1 σ). Dot: estimate. Line: 95 % interval, relative to the nominal value (tick). "
        "Friction has no trusted nominal value; its line shows the relative interval alone. Pale band: 95 % interval "
        "of the nominal value. An arrow leaves the scale. Grey rows are poorly determined or not identifiable."
    )
    return [r.ResultTable(columns, groups=groups, style="parameters", on=on), r.explain(reading)]


def _fold_unseen(rows: Sequence[ParameterRow]) -> list[ParameterRow]:
    """Return the rows; three or more of one link that are not identifiable alone for the same reason are joined to one row."""
    reasons: dict[tuple[str, str], list[ParameterRow]] = {}
    for row in rows:
        if row.state == "unseen":
            reasons.setdefault(_find_reason(row), []).append(row)
    folded: list[ParameterRow] = []
    for row in rows:
        alike = reasons.get(_find_reason(row), []) if row.state == "unseen" else []
        if len(alike) < 3:
            folded.append(row)
        elif row is alike[0]:
            owner, reason = _find_reason(row)
            parts = ", ".join(one.name.rsplit(".", 1)[1] for one in alike)
            folded.append(
                replace(
                    row,
                    name=f"{owner}: {parts}",
                    state="fold",
                    nominal="",
                    estimate="",
                    unit="",
                    before="",
                    note=reason,
                )
            )
    return folded


def _find_reason(row: ParameterRow) -> tuple[str, str]:
    """Return a parameter's link or joint, and why it is not identifiable, without the names of other parameters."""
    return row.name.rsplit(".", 1)[0], row.note.split(" with ")[0]


def _build_row(entry: ParameterRow, truth: bool, before: bool) -> r.Row:
    unseen = entry.state in ("unseen", "fold")
    value = f"{entry.estimate} {entry.unit}: " if unseen and entry.estimate else ""
    cells = [entry.name, entry.name, entry.nominal, *([entry.before] if before else []), entry.estimate, entry.unit]
    cells += [] if before else [entry.interval]
    cells += [
        entry.bar,
        *([entry.true, entry.distance] if truth else []),
        f"{value}{entry.note}".replace(" %", "\u00a0%"),
    ]
    return r.Row(cells, "fold" if unseen else entry.state, on=r.On.ALL if entry.is_told else r.On.DRAWN)


def compute_bar_scale(rows: list[dict[str, Any]]) -> float:
    """Return the bars' common half-width relative to the reference value, large enough for determined parameters."""
    extents = [0.05]
    for entry in rows:
        reference = entry["nominal"] or entry["value"]
        if entry["determined"] and reference:
            extents.append(max(abs(x - reference) for x in entry["ci95"]) / abs(reference))
    return float(min(1.0, _round_up(1.05 * float(np.quantile(extents, 0.95)))))


def _round_up(x: float) -> float:
    steps = np.array([0.05, 0.1, 0.2, 0.3, 0.5, 1.0])
    return float(steps[min(np.searchsorted(steps, x), len(steps) - 1)])


def describe_row(entry: dict[str, Any], scale: float, group: str, note: str) -> ParameterRow:
    """Return a parameter in the form of the contract as text."""
    seen, sigma = entry["stderr"] is not None, entry["stderr"]
    held = entry.get("split_value", entry["value"])  # the value in the model file
    known = max(abs(x) for x in (entry["value"], entry["nominal"] or 0.0, entry["nominal_stderr"] or 0.0))
    return ParameterRow(
        name=entry["name"],
        group=group,
        state="known" if entry["determined"] else "weak" if seen else "unseen",
        estimate=r.format_with_uncertainty(entry["value"], sigma) if seen else r.format_number(held),
        interval=r.format_interval(entry["ci95"], sigma) if seen else "",
        unit=r.format_unit(entry["unit"]),
        nominal="" if entry["nominal"] is None else r.format_number(entry["nominal"]),
        note=note,
        bar=_bar(entry, scale) if seen else None,
        is_told=seen and sigma <= known,
    )


def _compared(row: ParameterRow, entry: dict[str, Any], true: float) -> ParameterRow:
    sigma = entry["stderr"]
    text = r.format_number(true) if sigma is None else r.round_to_stderr(true, sigma)
    return replace(row, true=text, distance=f"{abs(entry['value'] - true) / sigma:.1f}" if sigma else "")


def name_group(model: Model, name: str) -> str:
    """Return the heading of a parameter: its joint, or the rigid body."""
    owner = name.rsplit(".", 1)[0]
    return _RIGID_BODY if name in model.robot.parameters and owner not in model.robot.actuated else owner


def _sort_groups(model: Model, rows: Sequence[ParameterRow]) -> list[ParameterRow]:
    """Return the rows with headings in the robot's order, those of effects on several joints last."""
    place = {name: k for k, name in enumerate((_RIGID_BODY, *model.robot.actuated))}
    return sorted(rows, key=lambda row: place.get(row.group, len(place)))


def _note(found: Identification, entry: dict[str, Any]) -> str:
    if entry["stderr"] is None:
        return _unseen(entry)
    plain = found.estimate.moved.get(entry["name"])
    if plain is not None:
        return f"constrained to be physically consistent; the unconstrained estimate is {r.format_number(plain, 3)}"
    return explain_unreliable(entry) or compare_with_nominal(entry)


def explain_unreliable(entry: dict[str, Any]) -> str:
    """Return the reason why an estimate is not reliable; empty if it is reliable."""
    if entry["at_bound"]:
        return "at its bound"
    if entry["determined"]:
        return ""
    if entry["ci95"][0] <= 0 <= entry["ci95"][1]:
        return "not significantly different from zero"
    return f"poorly determined: standard error {r.format_percent(100 * entry['stderr'] / abs(entry['value']))}"


def _unseen(entry: dict[str, Any]) -> str:
    shares = entry.get("depends_on") or []
    if not shares:
        return "not excited, nominal value kept" if entry["identifiable"] else "not identifiable, nominal value kept"
    return f"one of many splits with the same forces; identifiable only in combination with {r.format_list(shares, 3)}"


def compare_with_nominal(entry: dict[str, Any]) -> str:
    """Return the deviation of an estimate from its nominal value, if it exceeds both uncertainties."""
    nominal, trust = entry["nominal"], entry["nominal_stderr"]
    if not nominal:
        return ""
    change = (entry["value"] - nominal) / abs(nominal)
    if trust is None or abs(entry["value"] - nominal) < r.Z95 * np.hypot(entry["stderr"], trust):
        return ""
    return f"{r.format_percent(100 * abs(change))} {'above' if change > 0 else 'below'} nominal, significant (95 %)"


def _bar(entry: dict[str, Any], scale: float) -> r.IntervalBar | None:
    reference = entry["nominal"] or entry["value"]
    if not reference or abs(reference) < 1e-3 * entry["stderr"]:
        return None
    low, high, at = ((x - reference) / abs(reference) / scale for x in (*entry["ci95"], entry["value"]))
    trust = r.Z95 * entry["nominal_stderr"] / abs(reference) / scale if entry["nominal_stderr"] else 0.0
    cut = [float(np.clip(x, -1, 1)) for x in (low, high)]
    state = "known" if entry["determined"] else "weak"
    return r.IntervalBar(
        cut[0], cut[1], float(at) if abs(at) <= 1 else None, min(1.0, trust), state, entry["nominal"] is not None
    )


def build_extended_rows(model: Model, before: Parameters) -> tuple[list[ParameterRow], float]:
    """Return the rows of a model and of the same model without its causes, and the bars' half-width relative to the reference."""
    robot = model.robot
    nominal = load_robot_from_urdf(
        robot.urdf, robot.source, actuated=robot.actuated
    ).parameters  # of the file that it carries
    raw = [_raw(p, nominal) for p in model.parameters if p.free]
    scale = compute_bar_scale(raw)
    rows = [
        describe_row(entry, scale, name_group(model, entry["name"]), _note_extended(entry, before)) for entry in raw
    ]
    known = {p.name: r.format_with_uncertainty(p.value, p.stderr) for p in before}
    return _sort_groups(model, [replace(row, before=known.get(row.name, "")) for row in rows]), scale


def _raw(p: Parameter, nominal: Parameters) -> dict[str, Any]:
    known = nominal[p.name] if p.name in nominal else None
    sigma = p.stderr
    return {
        "name": p.name,
        "value": p.value,
        "unit": p.unit,
        "stderr": sigma,
        "ci95": None
        if sigma is None
        else [max(p.lower, p.value - r.Z95 * sigma), min(p.upper, p.value + r.Z95 * sigma)],
        "determined": sigma is not None and bool(sigma < MAX_RELATIVE_STDERR * abs(p.value)),
        "nominal": None if known is None else known.value,
        "nominal_stderr": None if known is None else compute_nominal_stderr(known),
        "at_bound": sigma is not None and p.at_bound,
    }


def _note_extended(entry: dict[str, Any], before: Parameters) -> str:
    if entry["stderr"] is None:
        return "identifiable only in combination"
    return explain_unreliable(entry) or ("new" if entry["name"] not in before else compare_with_nominal(entry))
