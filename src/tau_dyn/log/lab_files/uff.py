"""Universal files (UFF, UNV; extra `uff`): time records of accelerometers and forces, dataset 58, through the library `pyuff`.

A channel is named by what it measures, its node and its direction: `a_12z` is the acceleration of node 12 along z, `f_3x` a
force, `v_` a velocity, `x_` a displacement, `s_` anything else. A sensor that points along -z (direction -3) is turned round.
Values become SI: by the unit that the ordinate names, else by the factors of dataset 164. Channels that are in the file several
times are several records, such as blows of a hammer; they stand one after the other with a gap in time, which is never bridged.
Reference: Universal File Datasets Summary, University of Cincinnati, datasets 58 and 164.
"""

from __future__ import annotations

import contextlib
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256
from tau_dyn.log.column_names import format_names
from tau_dyn.log.table import Table

MAX_FILE_BYTES = 2**29  # as of a MATLAB file; a text of so many holds some forty million samples
MAX_DATASETS = 10_000  # each is read by itself; more bounds nothing but the time on a hostile file
GAP_S = 1.0  # [s] between records, at least
GAP_SAMPLES = 100  # and at least so many samples, so that no record seems to go on
STEP_TOLERANCE = 1e-5  # relative difference of sampling steps that counts as one step
_KINDS = {8: "x", 11: "v", 12: "a", 13: "f", 9: "f"}
"""What an ordinate is, by its specific data type."""
_AXES = ("", "x", "y", "z", "rx", "ry", "rz")
_TIME_RESPONSE, _COMPLEX = 1, (5, 6)
_UNITS = {
    "m/s2": ("a", 1.0), "g": ("a", 9.80665), "gn": ("a", 9.80665), "mm/s2": ("a", 1e-3), "in/s2": ("a", 0.0254),
    "m/s": ("v", 1.0), "mm/s": ("v", 1e-3), "um/s": ("v", 1e-6), "in/s": ("v", 0.0254),
    "m": ("x", 1.0), "mm": ("x", 1e-3), "um": ("x", 1e-6), "in": ("x", 0.0254),
    "n": ("f", 1.0), "kn": ("f", 1e3), "lbf": ("f", 4.4482216152605), "lb": ("f", 4.4482216152605),
}  # fmt: skip
"""What is measured in a unit, and the unit's size in SI."""
_POWERS = {"f": {"force": 1}, "a": {"length": 1}, "v": {"length": 1}, "x": {"length": 1}}


@dataclass(frozen=True, eq=False)
class UniversalChannel:
    """A time record of one sensor.

    Attributes:
        name: `a_12z`.
        start: Time of the first sample [s].
        dt: Sampling step [s].
        values: Samples (N,) in SI.
        unknown: The unit that is not known, as the file has it; empty otherwise.
    """

    name: str
    start: float
    dt: float
    values: np.ndarray
    unknown: str = ""


def read_uff(path: Path) -> Table:
    """Read the time records of a universal file as a table.

    Args:
        path: The file.

    Raises:
        InputError: The extra is missing, the file is damaged or too large, or it has no time records that go together.
    """
    _check(path)
    sets, factors = _read_sets(path)
    times = [s for s in sets if s.get("func_type") == _TIME_RESPONSE]
    if not times:
        kinds = f"; it has {len(sets)} functions of other types, such as frequency responses" if sets else ""
        raise InputError(
            "file_format",
            f"{path.name} has no time records (dataset 58, function type 1){kinds}; export the time data.",
        )
    channels = [_build_channel(path.name, s, factors) for s in times]
    records = _divide(path.name, channels)
    cells, starts, at = _join(records), [len(r[0].values) for r in records], path.name
    said = []
    if len(sets) > len(times):
        said.append(f"{at}: {len(sets) - len(times)} functions that are no time records are left out.")
    if unknown := sorted({f"{c.name} in '{c.unknown}'" for c in channels if c.unknown}):
        said.append(
            f"{at}: {format_names(unknown)}: a unit that is not known is left as it is; scale it in a column map."
        )
    if len(records) > 1:
        said.append(f"{at}: {len(records)} records of {starts[0]} samples stand one after the other.")
    places = np.arange(len(cells["t"]), dtype=np.int64) + 1
    return Table(path.name, path, compute_sha256(path), cells, places, "sample", tuple(said))


def _check(path: Path) -> None:
    """Refuse a file that is no universal file, or announces more samples than it has bytes."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(
            "file_too_large", f"{path.name} has more than {MAX_FILE_BYTES / 2**20:.0f} MB; export fewer channels."
        )
    announced, sets = 0, 0
    with path.open("rb") as file:
        if file.readline(200).strip() != b"-1":
            raise InputError("file_format", f"{path.name} is no universal file, which begins with a line '    -1'.")
        file.seek(0)
        header, before = -1, b""
        while line := file.readline(MAX_FILE_BYTES):
            header = header + 1 if header >= 0 else header
            if before == b"-1" and line.strip()[:3] in (b"58", b"58b"):
                header, sets = 0, sets + 1
            elif header == 7:
                announced, header = announced + _count_samples(path.name, line), -1
            before = line.strip()
            if sets > MAX_DATASETS or announced > size:
                raise InputError(
                    "damaged_file",
                    f"{path.name} announces more samples or functions than it can hold; export it again.",
                )


def _count_samples(name: str, line: bytes) -> int:
    """Return the number of samples that a function's seventh record announces."""
    try:
        count = int(line[10:20])
    except ValueError:
        count = -1
    if count < 0:
        raise InputError(
            "damaged_file", f"{name} is damaged: a function announces no number of samples; export it again."
        )
    return count


def _read_sets(path: Path) -> tuple[list[dict[str, Any]], Mapping[str, float]]:
    """Return the functions of a file, and the factors from SI to its units where dataset 164 states them."""
    try:
        import pyuff
    except ImportError:
        raise InputError(
            "missing_package", "reading universal files needs an extra: pip install 'tau_dyn[uff]'."
        ) from None
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # the library prints what it wonders about
            file = pyuff.UFF(str(path))
            kinds = [int(kind) for kind in file.get_set_types()]
            wanted = [k for k, kind in enumerate(kinds) if kind in (58, 164)]
            found: list[Any] = [file.read_sets(k) for k in wanted]
    except Exception as fault:  # the library raises whatever happens, most of it as a bare Exception
        text = " ".join(str(fault).split())[:80]
        raise InputError("damaged_file", f"{path.name} is damaged ({text}); export it again.") from None
    units = next((s for s in found if s.get("type") == 164), {})
    factors = {k: float(units[k]) for k in ("length", "force") if 1e-12 < abs(float(units.get(k) or 0)) < 1e12}
    return [s for s in found if s.get("type") == 58], factors


def _build_channel(file: str, found: Mapping[str, Any], factors: Mapping[str, float]) -> UniversalChannel:
    """Return a function as a channel in SI."""
    label = str(found.get("ordinate_axis_units_lab") or "").strip()
    known = _UNITS.get(
        label.lower().replace("^", "").replace("²", "2").replace("µ", "u").replace("μ", "u").strip("[]() ")
    )
    kind = _KINDS.get(int(found.get("ordinate_spec_data_type") or 0)) or (known[0] if known else "s")
    direction = int(found.get("rsp_dir") or 0)
    axis = _AXES[abs(direction)] if abs(direction) < len(_AXES) else f"d{abs(direction)}"
    name = f"{kind}_{int(found.get('rsp_node') or 0)}{axis}"
    data, count = np.asarray(found.get("data")), int(found["num_pts"])
    if found.get("ord_data_type") in _COMPLEX or data.ndim != 1 or len(data) < count or count < 2:
        raise InputError(
            "damaged_file", f"{file}: {name} breaks off, or is no record of real samples; export it again."
        )
    start, dt = float(found.get("abscissa_min") or 0.0), float(found.get("abscissa_inc") or 0.0)
    if not found.get("abscissa_spacing"):
        x = np.asarray(found["x"], dtype=float)[:count]
        start, dt = float(x[0]), float(np.mean(np.diff(x)))
        if not dt > 0 or np.abs(np.diff(x) / dt - 1).max() > 0.01:
            raise InputError("time_stamps", f"{file}: {name} is not evenly sampled; export it at a fixed rate.")
    if not (0 < dt < 1e6 and abs(start) < 1e12):
        raise InputError(
            "time_stamps", f"{file}: {name} has a sampling step of {dt:g} s; export it with its time axis."
        )
    scale, unknown = 1.0, ""
    if known and (known[0] == kind or kind == "s"):
        scale = known[1]
    elif label:
        unknown = label
    else:
        scale = 1 / float(np.prod([factors.get(k, 1.0) ** n for k, n in _POWERS.get(kind, {}).items()]))
    return UniversalChannel(name, start, dt, (-scale if direction < 0 else scale) * data[:count].astype(float), unknown)


def _divide(file: str, channels: Sequence[UniversalChannel]) -> list[list[UniversalChannel]]:
    """Return the channels record by record, each with the same channels and samples.

    Raises:
        InputError: Channels differ in number, length or sampling step.
    """
    counts = Counter(c.name for c in channels)
    n_records = min(counts.values())
    if max(counts.values()) != n_records:
        often = max(counts, key=lambda name: counts[name])
        rare = min(counts, key=lambda name: counts[name])
        raise InputError(
            "mismatch",
            f"{file} has {often} {counts[often]} times and {rare} {counts[rare]} times; give each sensor a node and a direction "
            "of its own, and export as many records of each.",
        )
    records: list[list[UniversalChannel]] = [[] for _ in range(n_records)]
    seen: Counter[str] = Counter()
    for c in channels:
        records[seen[c.name]].append(c)
        seen[c.name] += 1
    first = records[0][0]
    for record in records:
        for c in record:
            if len(c.values) != len(record[0].values) or abs(c.dt / first.dt - 1) > STEP_TOLERANCE:
                raise InputError(
                    "mismatch",
                    f"{file}: {c.name} has {len(c.values)} samples of {c.dt:g} s and {record[0].name} {len(record[0].values)} of "
                    f"{first.dt:g} s; export all channels of a record with the same length and rate.",
                )
            if abs(c.start - record[0].start) > 0.5 * first.dt:
                raise InputError(
                    "mismatch", f"{file}: {c.name} and {record[0].name} do not begin together; export one record."
                )
    return records


def _join(records: Sequence[Sequence[UniversalChannel]]) -> dict[str, np.ndarray]:
    """Return time and channels of all records one after the other, with gaps between."""
    names = [c.name for c in records[0]]
    by_record = [{c.name: c.values for c in record} for record in records]
    cells = {"t": np.concatenate(list(_yield_times(records)))}
    return cells | {name: np.concatenate([values[name] for values in by_record]) for name in names}


def _yield_times(records: Sequence[Sequence[UniversalChannel]]) -> Iterator[np.ndarray]:
    dt = records[0][0].dt
    at = records[0][0].start
    for record in records:
        n = len(record[0].values)
        yield at + dt * np.arange(n)
        at += n * dt + max(GAP_S, GAP_SAMPLES * dt)
