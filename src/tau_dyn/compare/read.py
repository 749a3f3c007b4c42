"""A model file (YAML) or a command's result (JSON) as quantities with standard errors, errors, and findings.

Results are read by what they hold, not by which command wrote them: `parameters` of identify, `findings` of diagnose, `modes`
of modes, `models` of calibrate. Values that no data determined have no standard error.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from tau_dyn.exceptions import InputError
from tau_dyn.model import Model

_DATA = (".csv", ".parquet", ".mcap")
_MOST = 64 * 2**20  # [bytes] a result is a few hundred kB


class Quantity(NamedTuple):
    """A value, its standard error (None where no data determined it), and its unit."""

    value: float
    stderr: float | None
    unit: str


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two things compared.

    Attributes:
        path: Its file.
        sha256: The file's hash.
        kind: `model`, or the command whose result it is.
        quantities: Parameters, resonances, dimensions by name.
        errors: Relative errors or fits in percent, or distances, by what they are called, with their unit.
        findings: Status by cause and joints.
        logs: Hashes of the data behind it.
    """

    path: Path
    sha256: str
    kind: str
    quantities: Mapping[str, Quantity]
    errors: Mapping[str, tuple[float, str]]
    findings: Mapping[tuple[str, tuple[str, ...]], str]
    logs: frozenset[str]


def read_side(path: str | Path) -> Side:
    """Read a model file or a result.

    Raises:
        InputError: The file is missing, neither a model nor a result of ours, or holds an entry of the wrong kind.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MOST:
            raise InputError(f"{path}: larger than 64 MiB, so no result or model of ours")
        data = path.read_bytes()
    except OSError as fault:
        raise InputError(f"{path}: {'no such file' if not path.exists() else 'cannot be read'}") from fault
    digest = hashlib.sha256(data).hexdigest()
    if path.suffix.lower() in (".yaml", ".yml"):
        return _of_model(path, digest)
    return _of_result(path, digest, data)


def _of_model(path: Path, digest: str) -> Side:
    model = Model.load(path)
    values = {p.name: Quantity(p.value, p.stderr, p.unit) for p in model.parameters}
    logs = frozenset(str(x["sha256"]) for x in _dicts(model.provenance.get("logs")) if "sha256" in x)
    return Side(path, digest, "model", values, {}, {}, logs)


def _of_result(path: Path, digest: str, data: bytes) -> Side:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as fault:
        raise InputError(f"{path}: neither a model file (.yaml) nor a result (.json): {fault}") from fault
    if not isinstance(content, dict) or not isinstance(content.get("command"), str):
        raise InputError(f"{path}: not a result of ours; its 'command' is missing")
    if content.get("status") == "cannot_answer":
        raise InputError(f"{path}: this result says that its data cannot answer; there is nothing to compare")
    try:
        quantities = {**dict(_parameters(content)), **dict(_modes(content)), **dict(_calibrated(content))}
        findings = {
            (str(x["cause"]), tuple(map(str, x.get("joints", [])))): str(x["status"])
            for x in _dicts(content.get("findings"))
        }
        errors = dict(_errors(content))
    except (KeyError, TypeError, ValueError, AttributeError) as fault:
        raise InputError(f"{path}: an entry of this result is missing or of the wrong kind ({fault})") from fault
    read = [
        x for x in _dicts(content.get("inputs")) if "sha256" in x and Path(str(x.get("path"))).suffix.lower() in _DATA
    ]
    logs = frozenset(str(x["sha256"]) for x in read)
    return Side(path, digest, content["command"], quantities, errors, findings, logs)


def _parameters(content: Mapping[str, Any]) -> Iterator[tuple[str, Quantity]]:
    for row in [
        *_dicts(content.get("parameters")),
        *(p for x in _dicts(content.get("findings")) for p in x["parameters"]),
    ]:
        yield str(row["name"]), _quantity(row["value"], row.get("stderr"), row.get("unit", ""))


def _modes(content: Mapping[str, Any]) -> Iterator[tuple[str, Quantity]]:
    for k, mode in enumerate(_dicts(content.get("modes")), 1):
        yield f"mode {k} frequency", _quantity(mode["frequency_hz"], mode["frequency_stderr"], "Hz")
        yield f"mode {k} damping", _quantity(mode["damping_ratio"], mode["damping_stderr"], "")


def _calibrated(content: Mapping[str, Any]) -> Iterator[tuple[str, Quantity]]:
    for model in _dicts(content.get("models")):
        if model["name"] == content.get("chosen"):
            for row in _dicts(model.get("parameters")):
                yield str(row["name"]), _quantity(row["value"], row.get("stderr"), row.get("unit", ""))


def _errors(content: Mapping[str, Any]) -> Iterator[tuple[str, tuple[float, str]]]:
    for part in ("train", "holdout", "baseline", "extended", "noise_floor"):
        entry = content.get(part)
        if isinstance(entry, dict) and entry.get("relative_error_percent") is not None:
            yield f"{part} error", (float(entry["relative_error_percent"]), "%")
    fit = content.get("fit_percent")
    for part, value in fit.items() if isinstance(fit, dict) else ():
        if isinstance(value, int | float):
            yield f"{part} fit", (float(value), "%")
    for model in _dicts(content.get("models")):
        held = model.get("holdout") if model["name"] == content.get("chosen") else None
        if isinstance(held, dict):
            yield "held-out position error, mean", (float(held["position"]["mean"]), "m")


def _quantity(value: Any, stderr: Any, unit: Any) -> Quantity:
    known = None if stderr is None or not isfinite(float(stderr)) or float(stderr) <= 0 else float(stderr)
    return Quantity(float(value), known, str(unit))


def _dicts(items: Any) -> list[dict[str, Any]]:
    return [x for x in items if isinstance(x, dict)] if isinstance(items, list) else []
