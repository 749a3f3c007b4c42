"""A model file (YAML), a command's result (JSON) or a run folder as quantities with standard errors, errors, and findings.

Results are read by their content, not by the command that wrote them: `parameters` and `base_parameters` of identify, `findings`
of diagnose and check, `modes` of modes, `models` of calibrate, plain numbers of all. Values that no data determined have no
standard error. A value has a standard error, a flag whether data or only a prior determine it, and is a single parameter or a
combination.

A combination `w' theta` is determined by a result whose base parameters are `beta = E theta` if and only if `w = E' c`; then it
is `c' beta`. The leading parameter of each base parameter is in no other one, so `c` is `w` at these. Thus two results are
compared for any choice of base: `a + b` of one is the same as `b + a`, twice `b/2 + a/2`, or the sum of `a` and `b` if the other
determines both.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.compare.run import RESULT, RUN, RecordedRun, is_run, read_run
from tau_dyn.estimate import read_expression
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.model import Model

_LEFT = 0.01
"""Relative distance of a standard error from its prior's below which the data added less than 2 % of the information."""
_STAYED = 0.2
"""Distance from the nominal value, in standard errors, within which a value without information from data counts as unchanged."""


class MeasuredQuantity(NamedTuple):
    """A value, its standard error (None if no data determined it), and its unit.

    `at_prior`: the standard error is that of the prior the value started from, so no data determined it either.
    """

    value: float
    stderr: float | None
    unit: str
    at_prior: bool = False

    @property
    def determined(self) -> bool:
        """Whether data determine the value."""
        return self.stderr is not None and not self.at_prior


def build_measured_quantity(
    value: Any, stderr: Any, unit: Any, *, prior: Any = None, nominal: Any = None
) -> MeasuredQuantity:
    """Return a value that was read; an invalid standard error, such as zero, is taken as unknown.

    Args:
        value: The value [unit].
        stderr: Its standard error [unit], or None.
        unit: Its unit.
        prior: Standard error of the prior value [unit], or None.
        nominal: Prior value [unit]; None if it is not given, then `prior` alone counts.

    Raises:
        TypeError: One of them is not a number.
        ValueError: A text is not a number.
        OverflowError: An integer is too large for a float.
    """
    known = None if stderr is None or not isfinite(float(stderr)) or float(stderr) <= 0 else float(stderr)
    held = known is not None and prior is not None and abs(known - float(prior)) <= _LEFT * float(prior)
    if known is not None and held and nominal is not None:
        held = abs(float(value) - float(nominal)) <= _STAYED * known
    return MeasuredQuantity(float(value), known, str(unit), held)


_TOLERANCE = 1e-5
"""Relative difference of two coefficients that are the same; they are written with six digits."""


@dataclass(frozen=True, eq=False)
class BaseParameterCombination:
    """One base parameter.

    Attributes:
        expression: The sum in words, such as `z3_link.mass + r4_link.mass`.
        weights: Coefficient of each parameter, by name.
        quantity: Its value and standard error.
    """

    expression: str
    weights: Mapping[str, float]
    quantity: MeasuredQuantity

    @property
    def alone(self) -> bool:
        """Whether it is a single parameter, which is among the parameters already."""
        return len(self.weights) == 1


@dataclass(frozen=True, eq=False)
class Combinations:
    """The base parameters of a result; empty for results without any, such as model files.

    Attributes:
        rows: The r base parameters by the leading parameter of each.
        correlation: Correlation of their estimates (r, r), in the order of `rows`; None if the result has no correlation.
        fixed: Values of the parameters that were given, by name.
    """

    rows: Mapping[str, BaseParameterCombination] = field(default_factory=dict)
    correlation: np.ndarray | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def joint(self) -> tuple[BaseParameterCombination, ...]:
        """Those of more than one parameter."""
        return tuple(row for row in self.rows.values() if not row.alone)

    def parts(self, weights: Mapping[str, float]) -> list[BaseParameterCombination]:
        """Return the base parameters that a combination would consist of."""
        return [self.rows[name] for name in weights if name in self.rows]

    def quantity_of(self, wanted: BaseParameterCombination) -> MeasuredQuantity | None:
        """Return another result's combination as these data determine it; None if they do not.

        The standard error of a sum of several base parameters follows from their standard errors and correlation.
        """
        rest, size, value = dict(wanted.weights), {n: abs(x) for n, x in wanted.weights.items()}, 0.0
        factors = [wanted.weights[name] for name in wanted.weights if name in self.rows]
        parts = self.parts(wanted.weights)
        for factor, part in zip(factors, parts, strict=True):
            value += factor * part.quantity.value
            for name, x in part.weights.items():
                rest[name] = rest.get(name, 0.0) - factor * x
                size[name] = size.get(name, 0.0) + abs(factor * x)
        for name, x in rest.items():
            if abs(x) > _TOLERANCE * size[name]:
                if name not in self.fixed:
                    return None
                value += x * self.fixed[name]
        stderr = self._stderr(factors, parts)
        return None if stderr is None else MeasuredQuantity(value, stderr, self._unit(wanted))

    def _unit(self, wanted: BaseParameterCombination) -> str:
        """Return the unit that the leading parameter has here; a combination led by another is scaled to the wanted unit."""
        lead = next(iter(wanted.weights))
        return self.rows[lead].quantity.unit if lead in self.rows else wanted.quantity.unit

    def _stderr(self, factors: list[float], parts: list[BaseParameterCombination]) -> float | None:
        sizes = [part.quantity.stderr for part in parts]
        known = np.array([s for s in sizes if s is not None])
        if not parts or len(known) < len(sizes):
            return None
        scaled = np.array(factors) * known
        if self.correlation is None and len(parts) > 1:
            return None
        order = {id(row): k for k, row in enumerate(self.rows.values())}
        at = [order[id(part)] for part in parts]
        alike = np.eye(1) if self.correlation is None or len(parts) == 1 else self.correlation[np.ix_(at, at)]
        variance = float(scaled @ alike @ scaled)
        return variance**0.5 if np.isfinite(variance) and variance > 0 else None


def read_combinations(content: Mapping[str, Any]) -> Combinations:
    """Read `base_parameters`, `correlation` and `fixed_parameters` of an identification's JSON.

    Raises:
        KeyError: An entry lacks its value or name.
        TypeError: An entry is of the wrong kind.
        ValueError: A text is no number, or the correlation is no table.
    """
    entries = list(pick_dicts(content.get("base_parameters")))
    listed = [*pick_dicts(content.get("parameters")), *pick_dicts(content.get("fixed_parameters")), *entries]
    names = {str(x["name"]) for x in listed if "name" in x}
    rows = dict(_row(x, names) for x in entries)
    matrix = np.asarray(content["correlation"], float) if rows and content.get("correlation") else None
    if matrix is not None and (matrix.shape != 2 * (len(rows),) or not np.isfinite(matrix).all()):
        matrix = None
    fixed = {str(x["name"]): float(x["value"]) for x in pick_dicts(content.get("fixed_parameters"))}
    return Combinations(rows, matrix, fixed)


def _row(entry: Mapping[str, Any], names: set[str]) -> tuple[str, BaseParameterCombination]:
    """Return a base parameter under its leading name; an expression that cannot be parsed is its own name."""
    lead, text = str(entry["name"]), str(entry.get("expression", entry["name"]))
    weights = read_expression(text)
    if not names.issuperset(weights) or weights.get(lead) != 1.0:
        lead, weights = text, {text: 1.0}
    weights = {lead: 1.0} | weights
    held = build_measured_quantity(entry["value"], entry.get("stderr"), entry.get("unit", ""))
    return lead, BaseParameterCombination(text, weights, held)


def pick_dicts(items: Any) -> list[dict[str, Any]]:
    """Return the mappings of a list; an empty list for other objects."""
    return [x for x in items if isinstance(x, dict)] if isinstance(items, list) else []


_NO_DATA = (".urdf", ".xacro", ".yaml", ".yml", ".json")  # robots, maps, models; recordings come in many kinds of files
_PARTS = ("train", "holdout", "baseline", "extended", "noise_floor")
_RMS = "unseen position error, rms"
_NO_ANSWER = ("seed", "search_s", "evaluations")  # options and duration of a run
_MAX_FILE_BYTES = 64 * 2**20  # [bytes] a result is a few hundred kB


@dataclass(frozen=True, eq=False)
class ComparedSide:
    """One of the two compared models, results or runs.

    Attributes:
        path: Its file.
        sha256: The file's hash.
        kind: `model`, or the command whose result it is.
        quantities: Parameters, resonances, dimensions by name.
        errors: Relative errors or fits in percent, or distances, by name, with their unit.
        findings: Status by cause and joints.
        logs: Hashes of the data behind it.
        inputs: Hash of each input file, by its path.
        intervals: 95 % intervals of errors, by name.
        gains: Gain of a finding on held-out data [%] and its 95 % interval, by cause and joints.
        numbers: Plain numbers of the result, by name.
        run: The run, if a run folder was read.
        missing: Information that the data lacked, if they could not answer.
        combinations: The combinations of parameters that the data determine.
    """

    path: Path
    sha256: str
    kind: str
    quantities: Mapping[str, MeasuredQuantity]
    errors: Mapping[str, tuple[float, str]]
    findings: Mapping[tuple[str, tuple[str, ...]], str]
    logs: frozenset[str]
    inputs: Mapping[str, str] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    gains: Mapping[tuple[str, tuple[str, ...]], tuple[float, float, float]] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    run: RecordedRun | None = None
    missing: str = ""
    combinations: Combinations = field(default_factory=Combinations)

    @property
    def place(self) -> Path:
        """The run folder, or the file."""
        return self.path if self.run is None else self.path.parent


def read_side(path: str | Path) -> ComparedSide:
    """Read a model file, a result or a run folder.

    Raises:
        InputError: It is missing, has another format, or holds an entry of the wrong kind.
    """
    path = Path(path)
    if not path.is_dir():
        return _of_file(path)
    if not is_run(path):
        raise InputError("file_format", f"{path}: a folder, but no run folder; it has no {RUN}")
    return _of_file(path / RESULT, read_run(path))


def _of_file(path: Path, run: RecordedRun | None = None) -> ComparedSide:
    try:
        data = read_bytes(path, _MAX_FILE_BYTES)
    except OSError as fault:
        raise InputError(
            "file_not_found", f"{path}: {'no such file' if not path.exists() else 'cannot be read'}"
        ) from fault
    digest = hashlib.sha256(data).hexdigest()
    if path.suffix.lower() in (".yaml", ".yml"):
        return _of_model(path, digest)
    return _of_result(path, digest, data, run)


def _of_model(path: Path, digest: str) -> ComparedSide:
    model = Model.load(path)
    values = {
        p.name: build_measured_quantity(p.value, p.stderr, p.unit, prior=p.prior_stderr) for p in model.parameters
    }
    used = [x for key in ("trained_on", "held_out") for x in pick_dicts(model.provenance.get(key))]
    logs = frozenset(str(x["sha256"]) for x in used if "sha256" in x)
    fixed = {p.name: p.value for p in model.parameters if not p.free}
    return ComparedSide(path, digest, "model", values, {}, {}, logs, combinations=Combinations(fixed=fixed))


def _of_result(path: Path, digest: str, data: bytes, run: RecordedRun | None) -> ComparedSide:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as fault:
        raise InputError(
            "file_format", f"{path}: neither a model file (.yaml) nor a result (--json) nor a run folder of ours"
        ) from fault
    if not isinstance(content, dict) or not isinstance(content.get("command"), str):
        raise InputError("file_format", f"{path}: not a result of ours; its 'command' is missing")
    unanswered = content.get("status") == "cannot_answer" and "fit_for_use" not in content  # a check names its faults
    refused = unanswered and "missing" in content
    if unanswered and run is None:
        raise InputError("mismatch", f"{path}: its data could not answer; there are no values to compare")
    read = [x for x in pick_dicts(content.get("inputs")) if "sha256" in x]
    try:
        return ComparedSide(
            path,
            digest,
            content["command"],
            {**dict(_parameters(content)), **dict(_modes(content)), **dict(_calibrated(content))},
            dict(_errors(content)),
            dict(_findings(content)),
            frozenset(str(x["sha256"]) for x in read if Path(str(x.get("path"))).suffix.lower() not in _NO_DATA),
            inputs={str(x.get("path")): str(x["sha256"]) for x in read},
            intervals=dict(_intervals(content)),
            gains=dict(_gains(content)),
            numbers=dict(_numbers(content)),
            run=run,
            missing=str(content["missing"]) if refused else "",
            combinations=read_combinations(content),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise InputError(
            "file_format", f"{path}: an entry of this result is missing or of the wrong kind ({fault})"
        ) from fault


def _findings(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, tuple[str, ...]], str]]:
    """Yield causes with their status; for a check of a log, topics with their severity, the worst last."""
    for row in pick_dicts(content.get("findings")):
        if "cause" in row:
            yield _key(row), str(row["status"])
    for severity in ("warning", "fault"):
        for row in pick_dicts(content.get("findings")):
            if row.get("severity") == severity:
                yield (str(row["topic"]), ()), severity


def _gains(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, tuple[str, ...]], tuple[float, float, float]]]:
    for row in pick_dicts(content.get("findings")):
        gain = row.get("gain")
        if not isinstance(gain, dict) or gain.get("reduction_percent") is None:
            continue
        if isinstance(gain.get("ci95"), list) and None not in gain["ci95"]:
            yield _key(row), (float(gain["reduction_percent"]), *_pair(gain["ci95"]))


def _key(row: Mapping[str, Any]) -> tuple[str, tuple[str, ...]]:
    return str(row["cause"]), tuple(map(str, row.get("joints", [])))


def _intervals(content: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, float]]]:
    """Yield the intervals of errors, under the names of `_errors`."""
    for part in _PARTS:
        entry = content.get(part)
        if isinstance(entry, dict) and isinstance(entry.get("relative_ci95"), list):
            if None not in entry["relative_ci95"]:
                yield f"{part} error", _pair(entry["relative_ci95"])
    for rung in pick_dicts(content.get("waterfall")):
        if "models" in content and rung.get("step") == content.get("chosen"):
            yield _RMS, _pair(rung["ci95"])


def _pair(ends: Any) -> tuple[float, float]:
    low, high = ends
    return float(low), float(high)


def _numbers(content: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield plain numbers at the top of a result, a workspace's size, an accuracy study's largest errors."""
    for name, value in content.items():
        if isinstance(value, int | float) and not isinstance(value, bool) and name not in _NO_ANSWER:
            yield name, value
    if isinstance(size := content.get("size"), dict):
        yield f"{size['name']} [{size['unit']}]", float(size["value"])
    for method, entry in (content.get("methods") or {}).items() if isinstance(content.get("methods"), dict) else ():
        if isinstance(entry, dict) and entry.get("max") is not None:
            yield f"largest error, {method} [m]", float(entry["max"])


def _parameters(content: Mapping[str, Any]) -> Iterator[tuple[str, MeasuredQuantity]]:
    for row in [
        *pick_dicts(content.get("parameters")),
        *(p for x in pick_dicts(content.get("findings")) if "cause" in x for p in x["parameters"]),
    ]:
        known = {"prior": row.get("nominal_stderr"), "nominal": row.get("nominal")}
        yield (
            str(row["name"]),
            build_measured_quantity(
                row.get("split_value", row["value"]), row.get("stderr"), row.get("unit", ""), **known
            ),
        )


def _modes(content: Mapping[str, Any]) -> Iterator[tuple[str, MeasuredQuantity]]:
    for k, mode in enumerate(pick_dicts(content.get("modes")), 1):
        yield f"mode {k} frequency", build_measured_quantity(mode["frequency_hz"], mode["frequency_stderr"], "Hz")
        yield f"mode {k} damping", build_measured_quantity(mode["damping_ratio"], mode["damping_stderr"], "")


def _calibrated(content: Mapping[str, Any]) -> Iterator[tuple[str, MeasuredQuantity]]:
    for model in pick_dicts(content.get("models")):
        if model["name"] == content.get("chosen"):
            for row in pick_dicts(model.get("parameters")):
                yield str(row["name"]), build_measured_quantity(row["value"], row.get("stderr"), row.get("unit", ""))


def _errors(content: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, str]]]:
    for part in _PARTS:
        entry = content.get(part)
        if isinstance(entry, dict) and entry.get("relative_error_percent") is not None:
            yield f"{part} error", (float(entry["relative_error_percent"]), "%")
    fit = content.get("fit_percent")
    for part, value in fit.items() if isinstance(fit, dict) else ():
        if isinstance(value, int | float):
            yield f"{part} fit", (float(value), "%")
    for model in pick_dicts(content.get("models")):
        held = model.get("holdout") if model["name"] == content.get("chosen") else None
        if isinstance(held, dict):
            yield "held-out position error, mean", (float(held["position"]["mean"]), "m")
    for rung in pick_dicts(content.get("waterfall")):
        if "models" in content and rung.get("step") == content.get("chosen"):
            yield _RMS, (float(rung["rms"]), "m")
