"""A model file (YAML), a command's result (JSON) or a run folder as quantities with standard errors, errors, and findings.

Results are read by what they hold, not by which command wrote them: `parameters` and `base_parameters` of identify, `findings` of
diagnose and check, `modes` of modes, `models` of calibrate, plain numbers of all. Values that no data determined have no standard
error.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tau_dyn.compare.quantity import (
    Combinations,
    MeasuredQuantity,
    build_measured_quantity,
    pick_dicts,
    read_combinations,
)
from tau_dyn.compare.run import RESULT, RUN, RecordedRun, is_run, read_run
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.model import Model

_NO_DATA = (".urdf", ".xacro", ".yaml", ".yml", ".json")  # robots, maps, models; recordings come in many kinds of files
_PARTS = ("train", "holdout", "baseline", "extended", "noise_floor")
_RMS = "unseen position error, rms"
_NO_ANSWER = ("seed", "search_s", "evaluations")  # what a run was asked, and how long it took
_MAX_FILE_BYTES = 64 * 2**20  # [bytes] a result is a few hundred kB


@dataclass(frozen=True, eq=False)
class ComparedSide:
    """One of the two things compared.

    Attributes:
        path: Its file.
        sha256: The file's hash.
        kind: `model`, or the command whose result it is.
        quantities: Parameters, resonances, dimensions by name.
        errors: Relative errors or fits in percent, or distances, by what they are called, with their unit.
        findings: Status by cause and joints.
        logs: Hashes of the data behind it.
        inputs: Hash of each file that went in, by its path.
        intervals: 95 % intervals of errors, by what they are called.
        gains: What a finding is worth on unseen data [%] and its 95 % interval, by cause and joints.
        numbers: Plain numbers of the result, by name.
        run: The run, where a run folder was read.
        missing: What the data lacked, where they could not answer.
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
        InputError: It is missing, none of these, or holds an entry of the wrong kind.
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
    refused = content.get("status") == "cannot_answer" and "missing" in content
    if content.get("status") == "cannot_answer" and run is None:
        raise InputError(
            "mismatch", f"{path}: this result says that its data cannot answer; there is nothing to compare"
        )
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
    """Yield causes with their status; of a check of a log, topics with their severity, the worst last."""
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
        *(p for x in pick_dicts(content.get("findings")) for p in x["parameters"]),
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
