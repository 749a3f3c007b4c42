"""Clocks of a log as text: dates, times of day, day fractions; and signals of several clocks on a common one.

Text clocks are read to the nanosecond and become seconds from the first sample; a time of day may cross midnight. Numbers in
days, as in spreadsheets and MATLAB, are recognised by their size and step. Signals of another clock (another file, or
columns that are filled in other rows) are interpolated by `resample_to_clock`, which refuses gaps and signals that change too
fast, onto the slowest clock of those that a fit compares: an interpolated force would repeat its noise.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.log.column_names import format_names, is_blank, split_column_name
from tau_dyn.log.resample import resample_to_clock
from tau_dyn.message_codes import CodedWarning

SECONDS_A_DAY = 86400.0
"""Length of a day [s]; leap seconds are not in the clocks of recorders."""

MAX_RATE_HZ = 2e5
"""Highest sampling rate of recorders of machines [Hz]: faster clocks count another unit."""

MIN_LENGTH_S = 0.01
"""Shortest recording of a motion or a hammer blow [s]."""

_DATE_NUMBERS = ((20_000.0, 80_000.0), (690_000.0, 800_000.0))
"""Days from 1900 (spreadsheets) and from year 0 (MATLAB) of the years 1954 to 2119 and 1889 to 2190."""

MIN_OVERLAP = 0.5
"""Share of the common clock's samples that every other clock has to cover, as for topics in a bag."""

COMPARED = ("q", "tau", "cmd")
"""Signals that a fit compares; the slowest of their clocks is the common one."""

_TEXT = (
    r"^\s*(?:(?:(?P<y>\d{4})[-/.](?P<mo>\d{1,2})[-/.](?P<d>\d{1,2})|(?P<a>\d{1,2})[-/.](?P<b>\d{1,2})[-/.](?P<yy>\d{4}|\d{2})"
    r"|(?P<days>\d{1,6}) days?)[T ,;]\s*)?(?P<h>\d{1,2}):(?P<m>\d{1,2})(?::(?P<s>\d{1,2}))?(?:[.,](?P<f>\d{1,12}))?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?\s*$"
)
"""A date (year first, or last) or a number of days, then hours, minutes, seconds; without a third number, minutes and seconds
with a fraction, as spreadsheets show them."""

_NS = 10**9
"""Nanoseconds of a second."""


class Clock(NamedTuple):
    """Times (N,) [s] from an epoch [ns], NaN for a row without a time, and a remark on how they were read."""

    t: NDArray[np.float64]
    epoch: int = 0
    remark: str = ""


def read_text_clock(cells: NDArray[Any]) -> Clock | None:
    """Return the times of dates, times of day or durations; None if a filled cell has another form.

    Args:
        cells: Text, or dates of a Parquet file (N,).
    """
    if cells.dtype.kind in "mM":
        ns, missing = cells.astype(f"{cells.dtype.kind}8[ns]").astype(np.int64), np.isnat(cells)
    elif cells.dtype.kind == "O" and len(cells) and isinstance(cells[0], pd.Timestamp):
        stamps: Any = pd.to_datetime(pd.Series(cells), utc=True)
        missing = stamps.isna().to_numpy()
        ns = stamps.dt.tz_localize(None).to_numpy().astype("M8[ns]").astype(np.int64)
    elif cells.dtype.kind in "OUS":
        found = _parse_text(cells)
        if found is None:
            return None
        ns, missing = found
    else:
        return None
    if missing.all():
        return None
    epoch = int(ns[~missing][0])
    return Clock(
        np.where(missing, np.nan, (ns - epoch) / _NS),
        epoch,
        "holds dates or times of day; t is in seconds from the first",
    )


def _parse_text(cells: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.bool_]] | None:
    """Return times (N,) [ns], and which cells are missing; None if a filled cell is no time."""
    first = next((cell for cell in cells if not is_blank(cell)), "")
    if not re.match(_TEXT, str(first)):
        return None
    text: Any = pd.Series(cells).astype(str)
    parts: Any = text.str.extract(_TEXT)
    unread = parts["h"].isna()
    missing = np.zeros(len(cells), dtype=bool)
    missing[unread] = [is_blank(cell) for cell in cells[unread.to_numpy()]]
    if bool((unread.to_numpy() & ~missing).any()):
        return None
    of_day = _compute_time_of_day(parts)
    if of_day is None:
        return None
    days = _compute_days(parts)
    if days is None:
        return None
    ns = days * int(SECONDS_A_DAY) * _NS + of_day
    dated = bool(parts[["y", "a", "days"]].notna().to_numpy().any())
    period = 24 * 3600 * _NS if parts["s"].notna().any() else 3600 * _NS  # minutes and seconds begin again each hour
    return (ns if dated else _unwrap(ns, missing, period)), missing


def _int(values: Any) -> NDArray[np.int64]:
    return values.fillna("0").astype(np.int64).to_numpy()


def _compute_time_of_day(parts: Any) -> NDArray[np.int64] | None:
    """Return the time of day (N,) [ns], minus the zone's offset; None for hours or minutes that do not exist."""
    hours, minutes, seconds = (_int(parts[key]) for key in "hms")
    if not parts["s"].notna().any() and parts["f"].notna().any():  # 15:30.5 is minutes and seconds
        hours, minutes, seconds = np.zeros_like(hours), hours, minutes
    half = parts["half"].fillna("").str.lower().to_numpy()
    hours = np.where(half == "pm", hours % 12 + 12, np.where(half == "am", hours % 12, hours))
    if hours.max() > 24 or minutes.max() > 59 or seconds.max() > 60:
        return None
    fraction = parts["f"].fillna("0").str.ljust(9, "0").str.slice(0, 9).astype(np.int64).to_numpy()
    zone = parts["zone"].fillna("").str.replace(":", "", regex=False).str.extract(r"([+-])(\d{2})(\d{2})")
    offset = (_int(zone[1]) * 60 + _int(zone[2])) * np.where(zone[0] == "-", -1, 1)
    return ((hours * 60 + minutes - offset) * 60 + seconds) * _NS + fraction


def _compute_days(parts: Any) -> NDArray[np.int64] | None:
    """Return days from 1970 (N,), or those of a duration; for dates with the year last, in the order of increasing days."""
    if parts["days"].notna().any():
        return _int(parts["days"])
    if parts["y"].notna().any():
        return _count_days(parts["y"], parts["mo"], parts["d"])
    if parts["a"].notna().any():
        orders = (_count_days(parts["yy"], parts["b"], parts["a"]), _count_days(parts["yy"], parts["a"], parts["b"]))
        found = [days for days in orders if days is not None]
        return min(found, key=lambda days: (np.any(np.diff(days) < 0), np.ptp(days))) if found else None
    return np.zeros(len(parts), dtype=np.int64)


def _count_days(year: Any, month: Any, day: Any) -> NDArray[np.int64] | None:
    years = _int(year)
    table: Any = pd.DataFrame(
        {"year": np.where(years < 100, 2000 + years, years), "month": _int(month), "day": _int(day)}
    )
    missing = year.isna().to_numpy()
    known = table.drop_duplicates()
    dates: Any = pd.to_datetime(known[(known["month"] > 0) & (known["day"] > 0)], errors="coerce")
    keys = (table["year"] * 10_000 + table["month"] * 100 + table["day"]).to_numpy()
    days = dict(zip(keys[dates.index], dates.to_numpy().astype("M8[D]"), strict=True))
    if any(np.isnat(x) for x in days.values()) or set(keys[~missing]) - set(days):
        return None
    return np.array([0 if lost else days[key].astype(np.int64) for key, lost in zip(keys, missing, strict=True)])


def _unwrap(ns: NDArray[np.int64], missing: NDArray[np.bool_], period: int) -> NDArray[np.int64]:
    """Return times that wrap after a period as increasing times."""
    known = ns[~missing]
    turns = np.cumsum(np.diff(known, prepend=known[:1]) < -period // 2)
    out = ns.copy()
    out[~missing] = known + turns * period
    return out


def find_day_numbers(t: NDArray[np.float64]) -> bool:
    """Return whether a clock counts days: in seconds its rate or length would be impossible for a recorder."""
    known = t[np.isfinite(t)]
    steps = np.diff(known)
    if steps.size < 2 or not np.all(steps >= 0.0) or known[-1] <= known[0]:
        return False
    step = (known[-1] - known[0]) / steps.size
    dated = any(low <= known[0] <= high for low, high in _DATE_NUMBERS)
    short = known[-1] - known[0] < MIN_LENGTH_S and 0.0 <= known[0] < 1.0
    return step < 1.0 / MAX_RATE_HZ and (dated or short)


_COUNTERS = (2.0**16, 2.0**32)
"""Ranges of the counters that microcontrollers use as clocks."""

_WRAP_STEPS = 3.0
"""Largest distance from a counter's ends, in steps of the clock, at which it is taken to restart."""


def unwrap_counter(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return a clock (N,) whose counter restarts at its end as a rising one, and the counter's range; 0 without a restart."""
    known = np.flatnonzero(np.isfinite(t))
    steps = np.diff(t[known])
    back = steps < 0
    if not back.any() or back.mean() > 0.1:
        return t, 0.0
    near = _WRAP_STEPS * float(np.median(steps[~back]))
    before, after = t[known][:-1][back], t[known][1:][back]
    for size in _COUNTERS:
        for low in (0.0, -size / 2):
            if np.all((before >= low + size - near) & (before < low + size) & (after >= low) & (after <= low + near)):
                risen = t.copy()
                risen[known[1:]] += size * np.cumsum(back)
                return risen, size
    return t, 0.0


_SECONDS_NAME = re.compile(r"(.*?)(?:sec|secs|seconds)", re.IGNORECASE)
_NANOSECONDS = ("nanosec", "nsec", "nanosecs", "nsecs", "nanoseconds")


def find_split_clock(columns: Sequence[str]) -> tuple[str, str] | None:
    """Return the columns of whole seconds and of nanoseconds of a clock that has both, as stamps of ROS; None without them."""
    known = {column.lower(): column for column in columns}
    for column in columns:
        found = _SECONDS_NAME.fullmatch(column)
        if found is None or column.lower().endswith(_NANOSECONDS):
            continue
        rest = next((known[n] for word in _NANOSECONDS if (n := f"{found[1]}{word}".lower()) in known), None)
        if rest is not None:
            return column, rest
    return None


class Clocked(NamedTuple):
    """Channels (N,) of one clock [s], and where they come from."""

    where: str
    t: NDArray[np.float64]
    channels: Mapping[str, NDArray[np.float64]]


class Joined(NamedTuple):
    """Channels (M,) on the common clock, the group and rows (M,) of that clock, and remarks."""

    main: int
    rows: NDArray[np.int64]
    channels: dict[str, NDArray[np.float64]]
    warnings: tuple[str, ...]


def join_clocks(name: str, groups: Sequence[Clocked]) -> Joined:
    """Put channels of several clocks on the slowest one of those that a fit compares.

    Raises:
        InputError: The clocks cover too little of each other, or a signal cannot be interpolated.
    """
    for group in groups:
        _refuse_backwards(group)
    main = _find_slowest(groups)
    t = groups[main].t
    covered = np.ones(t.size, dtype=bool)
    for group in groups:
        covered &= (t >= group.t[0]) & (t <= group.t[-1])
    if covered.sum() < max(2.0, MIN_OVERLAP * t.size):
        ends = [f"{g.where} from {g.t[0]:.6g} to {g.t[-1]:.6g} s" for g in groups]
        raise InputError(
            "mismatch",
            f"{name}: its clocks have too little time in common ({format_names(ends, 4)}); give parts of one recording.",
        )
    rows = np.flatnonzero(covered)
    channels = {key: values[rows] for key, values in groups[main].channels.items()}
    said: list[str] = []
    for group in (g for k, g in enumerate(groups) if k != main):
        for column, values in group.channels.items():
            channels[column], how = resample_to_clock(f"{group.where}: {column}", group.t, values, t[rows])
            said += [f"{group.where}: {column} was put on the clock of {groups[main].where}: {how}."] if how else []
    return Joined(main, rows, channels, tuple(CodedWarning("clocks_joined", sentence) for sentence in said))


def _find_slowest(groups: Sequence[Clocked]) -> int:
    """Return the number of the group with the longest step among those with a compared signal, else among all."""
    compared = [k for k, g in enumerate(groups) if any(_is_compared(c) for c in g.channels)] or range(len(groups))
    return max(compared, key=lambda k: float(np.median(np.diff(groups[k].t))))


def _is_compared(column: str) -> bool:
    pair = split_column_name(column)
    return pair is not None and pair[0] in COMPARED


def _refuse_backwards(group: Clocked) -> None:
    if group.t.size < 2 or np.any(np.diff(group.t) <= 0.0):
        raise InputError(
            "time_stamps", f"{group.where}: its clock does not rise from sample to sample; cut the log there."
        )


def measure_coarse_rate(cells: NDArray[Any]) -> float | None:
    """Return the samples per second [Hz] of a text clock whose stamps have whole seconds only; None for other clocks."""
    text = [str(cell) for cell in cells[: 2**16] if not is_blank(cell)]
    changes = [k for k in range(1, len(text)) if text[k] != text[k - 1]]
    if not changes or any(re.search(r":\d+[.,]\d", cell) for cell in text):
        return None
    rate = (changes[-1] - changes[0]) / (len(changes) - 1) if len(changes) > 1 else len(text) / 2
    return rate if rate > 1.0 else None


def describe_coarse_text(cells: NDArray[Any]) -> str:
    """Return the fault of a text clock of whole seconds; empty for other clocks."""
    rate = measure_coarse_rate(cells)
    if rate is None:
        return ""
    return (
        f"the stamps have whole seconds, of which one holds about {rate:.4g} samples; export fractions of a second, or give "
        f"the rate as `t: {{rate_hz: {rate:.4g}}}` in a column map"
    )
