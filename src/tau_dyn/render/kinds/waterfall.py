"""The waterfall: the residual after each step from the nominal robot to the noise floor.

Errors are in percent of the measured output, so that joints of different size and unit can be compared. The interval over all
outputs combines those of the outputs as if they were independent: with `S = sum_k n_k rms_k^2`, the upper end of S is
`S + sqrt(sum_k n_k^2 (u_k^2 - rms_k^2)^2)` for the outputs' upper ends `u_k`; the lower end is computed in the same way (method
of variance estimates recovery: Zou & Donner 2008).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn import results as r
from tau_dyn.evidence import Diagnosis, Finding, OutputErrors
from tau_dyn.parameters import Parameter

TEST_PART = 2
"""Part of a trace on which the errors are measured."""
CUT = 2.5
"""Ratio of the first bar to the longest other bar above which the first is cut."""


@dataclass(frozen=True)
class WaterfallStep:
    """One step: its name and its residual, in percent of the measured output.

    Attributes:
        label: Its name.
        about: Its additions, as phrases of which the last ones may be omitted.
        kind: `start`, `cause` or `floor`.
        finding: Number of its finding, from 1; 0 without a finding.
        joints: The joints of its finding.
        left: Residual [%]; NaN if the size of the output is unknown.
        low: Lower end of the 95 % interval [%].
        high: Upper end [%].
        previous: Residual of the step before [%]; NaN for the first and for the noise floor.
        rms: The residual's rms with its unit; empty over several outputs.
    """

    label: str
    about: tuple[str, ...]
    kind: str
    finding: int
    joints: tuple[str, ...]
    left: float
    low: float
    high: float
    previous: float
    rms: str


@dataclass(frozen=True)
class WaterfallSeries:
    """All steps for one output, or for all outputs.

    Attributes:
        output: The output's name; empty for all.
        rungs: The steps.
        floor: The noise floor [%].
        end: End of the axis [%].
    """

    output: str
    rungs: tuple[WaterfallStep, ...]
    floor: float
    end: float

    def draw(self, step: WaterfallStep) -> r.StepBar:
        """Return a step's bar on this axis."""
        unit = self.end if self.end > 0 else float("nan")
        ends = step.low / unit, step.high / unit
        return r.StepBar(step.left / unit, *ends, step.previous / unit, self.floor / unit, step.kind)


@dataclass(frozen=True, eq=False)
class OutputScale:
    """Size of the outputs on the test data: rms (m,) and number of samples (m,); NaN if unknown."""

    rms: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> OutputScale:
        """Return the size of the outputs on the test data."""
        squares, count = np.zeros((2, len(diagnosis.outputs)))
        for trace in diagnosis.traces:
            judged = trace.usable & (trace.part == TEST_PART)[:, None]
            squares += np.sum(np.where(judged, trace.measured, 0.0) ** 2, axis=0)
            count += judged.sum(axis=0)
        rms = np.sqrt(squares / np.where(count > 0, count, np.nan))
        return cls(np.where(rms > 0, rms, np.nan), count)

    def share(self, errors: OutputErrors, k: int) -> tuple[float, float, float]:
        """Return one output's error and its 95 % interval [%]."""
        scale = 100 / self.rms[k]
        return scale * float(errors.rms[k]), scale * float(errors.ci95[k, 0]), scale * float(errors.ci95[k, 1])

    def total(self, errors: OutputErrors) -> tuple[float, float, float]:
        """Return the error over all outputs and its 95 % interval [%]."""
        error, (low, high) = errors.relative_error_percent, errors.relative_ci95
        if np.isfinite(low):
            return error, low, high
        n = np.where(self.count > 0, self.count, 0.0) if self.count.any() else np.ones(len(errors.rms))
        squares = n * errors.rms**2
        whole = float(squares.sum())
        if not whole > 0:
            return error, error, error
        ends = n[:, None] * errors.ci95**2
        below, above = np.sqrt(np.sum((ends - squares[:, None]) ** 2, axis=0))
        return error, error * float(np.sqrt(max(0.0, 1 - below / whole))), error * float(np.sqrt(1 + above / whole))


def build_total_series(diagnosis: Diagnosis) -> WaterfallSeries:
    """Return the steps over all outputs."""
    yardstick = OutputScale.of(diagnosis)
    units = set(diagnosis.units)
    single = len(diagnosis.outputs) == 1 and len(units) == 1
    rungs = _rungs(diagnosis, yardstick.total, 0 if single else None)
    return WaterfallSeries("", rungs, rungs[-1].left, _end(rungs))


def build_output_series(diagnosis: Diagnosis) -> list[WaterfallSeries]:
    """Return the steps of each output, all on one axis; an empty list for a single output."""
    yardstick, outputs = OutputScale.of(diagnosis), diagnosis.outputs
    known = [k for k in range(len(outputs)) if np.isfinite(yardstick.rms[k])]
    if len(outputs) < 2 or not known:
        return []
    found = {k: _rungs(diagnosis, lambda errors, k=k: yardstick.share(errors, k), k) for k in known}
    end = max(_end(rungs) for rungs in found.values())
    return [WaterfallSeries(outputs[k], rungs, rungs[-1].left, end) for k, rungs in found.items()]


def _rungs(diagnosis: Diagnosis, share, k: int | None) -> tuple[WaterfallStep, ...]:
    rungs: list[WaterfallStep] = []
    for step in diagnosis.waterfall:
        finding = find_step_finding(step.step, diagnosis.findings)
        label, about, kind = _said(step.step, finding, diagnosis.findings)
        left, low, high = share(step.errors)
        previous = rungs[-1].left if rungs and kind != "floor" else float("nan")
        rms = "" if k is None else r.format_quantity(float(step.errors.rms[k]), diagnosis.units[k], steadily=True)
        place = 0 if finding is None else 1 + diagnosis.findings.index(finding)
        joints = () if finding is None else finding.joints
        rungs.append(WaterfallStep(label, about, kind, place, joints, left, low, high, previous, rms))
    return tuple(rungs)


def _end(rungs: tuple[WaterfallStep, ...]) -> float:
    """Return the end of the axis: at the longest bar, or before the end of a first bar that is much longer than the others."""
    ends = [row.high for row in rungs if np.isfinite(row.high)]
    others = max(ends[1:], default=0.0)
    first = ends[0] if ends else 1.0
    return 1.45 * others if others > 0 and first > CUT * others else 1.04 * max([first, others, 1e-9])


def find_step_finding(step: str, findings: tuple[Finding, ...]) -> Finding | None:
    """Return the finding of a step, whose name is a cause followed by joints; None if the name is ambiguous."""
    cause, *joints = re.split(r"[\s,:()+]+", step.strip(" +)")) or [""]
    alike = [f for f in findings if f.cause == cause]
    exact = [f for f in alike if set(f.joints) == set(joints)]
    return exact[0] if exact else alike[0] if len(alike) == 1 else None


def _said(step: str, finding: Finding | None, findings: tuple[Finding, ...]) -> tuple[str, tuple[str, ...], str]:
    if step == "nominal":
        return "nominal parameters", ("as in the robot file",), "start"
    if step == "refitted":
        return "refitted", ("masses and friction",), "start"
    if step == "noise_floor":
        return "noise floor", ("estimated error without any model error",), "floor"
    if finding is None:
        return f"+ {step}", (), "cause"
    several = sum(f.cause == finding.cause for f in findings) > 1
    return (
        f"+ {finding.cause}{f' {r.format_list(finding.joints)}' if several else ''}",
        format_finding(finding),
        "cause",
    )


def format_finding(finding: Finding, most: int = 3) -> tuple[str, ...]:
    """Return joints and main figures of a finding, such as `cart2`, `1.80 ± 0.10 N`, `period 20.9 mm`."""
    owners = {p.name.rsplit(".", 1)[0] for p in finding.parameters if "." in p.name}
    several = len([p for p in finding.parameters if p.unit == finding.parameters[0].unit]) > 1
    parts = []
    for k, p in enumerate(finding.parameters[:most]):
        name = p.name if len(owners) > 1 else p.name.rsplit(".", 1)[-1]
        parts.append(_format_size(finding, p) if not k and not several else f"{name} {r.format_estimate(p)}")
    more = len(finding.parameters) - most
    joints = [r.format_list(finding.joints, 4)] if finding.joints else []
    return (*joints, *parts, *([f"{more} more"] if more > 0 else []))


def _format_size(finding: Finding, p: Parameter) -> str:
    """Return an estimate; for a body's mass, whether it is the total or the difference from the robot file."""
    if p.name.endswith(".mass_error"):
        return f"{r.format_estimate(replace(p, value=abs(p.value)))} {'more' if p.value > 0 else 'less'} than nominal"
    whole = finding.status == "parameter" and p.name in {f"{link}.mass" for link in finding.joints}
    return f"{r.format_estimate(p)} in all" if whole else r.format_estimate(p)


def build_total_table(series: WaterfallSeries) -> r.ResultTable:
    """Return the steps over all outputs as a table."""
    shares = dict(zip(series.rungs, format_shares([step.left for step in series.rungs]), strict=True))
    return r.tabulate_things(
        series.rungs,
        r.Column(cell=lambda step: step.label),
        r.Column(kind="step", cell=series.draw),
        r.Column(kind="number", style="strong", cell=lambda step: shares[step]),
        r.Column(kind="number", style="quiet spread", on=r.On.PAGE, cell=format_spread),
        r.Column(style="about quiet", on=r.On.PRINTED, cell=lambda step: step.about),
        r.Column(on=r.On.NOTEBOOK, cell=lambda step: r.format_list(step.joints)),
        state=lambda step: step.kind,
        link=_link_finding,
        style="waterfall",
        on=r.On.ALL,
    )


def build_output_tables(parts: list[WaterfallSeries]) -> list[r.Element]:
    """Return the steps of every output as small tables; the steps of an output's own causes are highlighted."""
    return [
        r.tabulate_things(
            part.rungs,
            r.Column(cell=lambda step: step.label.replace(" parameters", "")),
            r.Column(kind="step", cell=part.draw),
            r.Column(kind="number", style="strong", cell=lambda step: format_share(step.left)),
            r.Column(kind="number", style="quiet", cell=lambda step: step.rms),
            state=lambda step, output=part.output: f"{step.kind} acts" if output in step.joints else step.kind,
            link=_link_finding,
            style="waterfall",
            caption=part.output,
        )
        for part in parts
    ]


def _link_finding(step: WaterfallStep) -> str:
    return f"finding-{step.finding}" if step.finding else ""


def format_share(share: float) -> str:
    """Return the residual of a step; empty if the size of the output is unknown."""
    return r.format_percent(share) if np.isfinite(share) else ""


def format_shares(shares: Sequence[float]) -> list[str]:
    """Return the residual of each step; equal texts get more digits, up to four, to distinguish them."""
    texts = [format_share(x) for x in shares]
    for text in {t for t in texts if t and texts.count(t) > 1}:
        alike = [k for k, t in enumerate(texts) if t == text]
        finer = {n: [r.format_percent(shares[k], n) for k in alike] for n in (3, 4)}
        if len(set(finer[4])) > 1:
            digits = 3 if len(set(finer[3])) == len(set(finer[4])) else 4
            for k, new in zip(alike, finer[digits], strict=True):
                texts[k] = new
    return texts


def format_spread(step: WaterfallStep) -> str:
    """Return a step's 95 % interval."""
    if not np.isfinite(step.low):
        return ""
    low, high = r.format_percent(step.low), r.format_percent(step.high)
    return f"{low.removesuffix(' %')} … {high}"
