"""Writes one recording as people have it, and states the expected result.

A case is drawn from its seed: a recording, then a clock, a layout, and at most one further oddity. The reference (`files.md`,
"Text files of other programs") decides whether it is read or refused.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml
from everyday_parts.case import Case, Layout
from everyday_parts.spoil import SPOILT

JOINTS = ("axis", "j1", "shoulder_pan_joint", "Achse_2", "left")


def _number(layout: Layout, digits: int) -> Callable[[float], str]:
    return lambda x: "" if np.isnan(x) else f"{x:.{digits}f}".replace(".", layout.decimal)


START = datetime.datetime(2026, 3, 2, 23, 59, 55, 250_000)


def _stamp(form: str) -> Callable[[float], str]:
    def write(t: float) -> str:
        x = START + datetime.timedelta(microseconds=round(1e6 * t))
        return {
            "ISO": lambda: x.isoformat(" ", "microseconds"),
            "ISO T Z": lambda: x.isoformat("T", "microseconds") + "Z",
            "ISO zone": lambda: x.isoformat("T", "microseconds") + "+02:00",
            "ISO short": lambda: x.isoformat(" "),
            "German": lambda: x.strftime("%d.%m.%Y %H:%M:%S.%f"),
            "German comma": lambda: x.strftime("%d.%m.%Y %H:%M:%S,%f"),
            "US": lambda: x.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
            "time of day": lambda: x.strftime("%H:%M:%S.%f"),
            "minutes": lambda: x.strftime("%M:%S.%f"),
        }[form]()

    return write


STAMPS = ("ISO", "ISO T Z", "ISO zone", "ISO short", "German", "German comma", "US", "time of day", "minutes")
CLOCKS = (
    "seconds",
    "epoch",
    "ms mapped",
    "ms as t",
    "ns as t",
    "Excel days",
    "MATLAB days",
    "whole seconds",
    "rate",
    "stamp",
)
ODDITIES = (
    "none",
    "none",
    "empty cells",
    "dead column",
    "two files",
    "topics",
    "signals in rows",
    "turns",
    "frozen",
    "cut",
    "spoilt",
    "spoilt",
)


def build_case(seed: tuple[int, int], folder: Path) -> Case:
    """Write the file of a seed into a folder and return the case."""
    g = np.random.default_rng(seed)
    joints = [str(j) for j in g.choice(JOINTS, g.integers(1, 4), replace=False)]
    rate = float(g.choice([50, 100, 125, 250, 500, 1000, 2000]))
    clock = str(g.choice(CLOCKS, p=[0.2, 0.08, 0.08, 0.04, 0.02, 0.08, 0.04, 0.02, 0.04, 0.4]))
    oddity = str(g.choice(ODDITIES))
    if oddity in ("two files", "topics", "signals in rows"):
        clock, rate = "seconds", max(rate, 100.0)
    if oddity == "frozen":
        clock = "seconds"
    rate = {"ms mapped": min(rate, 500.0), "ms as t": min(rate, 500.0)}.get(clock, rate)
    n = int(g.integers(300, 900)) if oddity != "frozen" else int(16 * min(rate, 250))
    rate = min(rate, 250.0) if oddity == "frozen" else rate
    t = np.arange(n) / rate
    signals = {f"{kind}_{j}": _draw_signal(g, kind) for j in joints for kind in ("q", "tau")}
    layout = _draw_layout(g)
    case = Case(
        f"{clock} / {oddity}", f"{clock}, {oddity}, {rate:g} Hz, {n} rows, {layout}", folder / "log.csv", ("log.csv",), t,
        {name: f(t) for name, f in signals.items()}, robot=_robot(joints, np.inf if oddity == "turns" else 4.0),
    )  # fmt: skip
    if oddity == "two files":
        return _write_two_files(case, layout, signals, rate, folder)
    if oddity == "topics":
        return _write_topics(case, layout, signals, rate)
    if oddity == "signals in rows":
        return _write_rows_of_signals(case, layout)
    return _write_table(case, layout, clock, oddity, g)


def _draw_signal(g: np.random.Generator, kind: str) -> Callable[[np.ndarray], np.ndarray]:
    a, f, p = g.uniform(0.1, 1.0, 3), g.uniform(0.1, 1.0, 3), g.uniform(0, 6.28, 3)
    size, offset = (1.0, g.uniform(-1, 1)) if kind == "q" else (float(g.choice([1.0, 30.0, 400.0])), g.uniform(-5, 5))
    return lambda t: offset + size * (a * np.sin(2 * np.pi * f * np.asarray(t)[:, None] + p)).sum(axis=1)


def _draw_layout(g: np.random.Generator) -> Layout:
    signs = [
        (",", ".", False),
        (";", ",", False),
        (";", ".", False),
        ("\t", ",", False),
        ("\t", ".", False),
        (",", ",", True),
    ]
    separator, decimal, quoted = signs[g.choice(6, p=[0.35, 0.3, 0.1, 0.1, 0.1, 0.05])]
    encoding = str(
        g.choice(["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"], p=[0.6, 0.15, 0.15, 0.05, 0.05])
    )
    blank = f"\n{separator * 2}\n {separator} {separator} \n"
    above = str(
        g.choice(["", "\n", blank, "# made by a recorder\n", f"sep={separator}\n"], p=[0.6, 0.1, 0.1, 0.1, 0.1])
    )
    return Layout(
        separator, decimal, quoted, encoding, str(g.choice(["\n", "\r\n", "\r"], p=[0.5, 0.45, 0.05])), above,
        end=separator if g.random() < 0.1 else "", last=str(g.choice(["", "\n\n", separator * 2 + "\n"], p=[0.8, 0.1, 0.1])),
    )  # fmt: skip


def _robot(joints: list[str], reach: float) -> Any:
    one = np.ones(len(joints))
    return SimpleNamespace(
        actuated=joints, joint_kinds=["revolute"] * len(joints), lower=-reach * one, upper=reach * one
    )


def _write_table(case: Case, layout: Layout, clock: str, oddity: str, g: np.random.Generator) -> Case:
    """Write one table with a clock of the kind asked for."""
    t, digits = case.t, int(g.integers(6, 10))
    channels = {name: np.array(x) for name, x in case.channels.items()}
    errors = dict.fromkeys(channels, 0.51 * 10.0**-digits)
    if oddity == "turns":
        name = next(n for n in channels if n.startswith("q_"))
        channels[name] = channels[name] + 2 * np.pi * g.uniform(20, 90) * t / t[-1]
    if oddity == "frozen":
        name = next(n for n in channels if n.startswith("q_"))
        channels[name] = np.full_like(t, channels[name][0])
        case = replace(case, frozen=name)
    number = _number(layout, digits)
    times, head, entry, case = _write_clock(case, layout, clock, g)
    cells = {name: [number(x) for x in values] for name, values in channels.items()}
    kept = np.ones(len(t), bool)
    if oddity == "empty cells":
        name = str(g.choice(list(cells)))
        blank = str(g.choice(["", "nan", "NaN", "NULL", "#N/A"]))
        for k in g.choice(len(t), g.integers(1, 20), replace=False):
            cells[name][k], kept[k] = blank, False
    if oddity == "dead column":
        name = next(n for n in cells if n.startswith("tau_"))
        cells[name] = [str(g.choice(["nan", "NaN"]))] * len(t)
        channels.pop(name)
    rows = [list(row) for row in zip(*([times] if times else []), *cells.values(), strict=True)]
    layout.write(case.path, [*([head] if times else []), *cells], rows)
    if oddity == "cut":
        data = case.path.read_bytes()
        shorter = Layout(**{**layout.__dict__, "last": "", "end": ""})
        shorter.write(case.path, [*([head] if times else []), *cells], rows)
        data = case.path.read_bytes()
        wide = 2 if layout.encoding.startswith("utf-16") else 1
        case.path.write_bytes(data[: -wide * int(g.integers(len(rows[-1][-1]) + 3, len(rows[-1][-1]) + 8))])
        kept[-1] = False
    if oddity == "spoilt":
        name = str(g.choice(list(SPOILT)))
        case = replace(case, described=f"{name}: {case.described}", kind=f"{case.kind.split(' /')[0]} / {name}")
        case = SPOILT[name](case, layout, [*([head] if times else []), *cells], rows, int(g.integers(50, 250)))
    if entry is not None:
        path = case.path.with_name("map.yaml")
        path.write_text(yaml.safe_dump({"t": entry, **{name: name for name in channels}}), encoding="utf-8")
        case = replace(case, map=path)
    return replace(
        case, t=case.t[kept], channels={n: x[kept] for n, x in channels.items()}, errors=errors, turns=oddity == "turns"
    )


def _write_clock(case: Case, layout: Layout, clock: str, g: np.random.Generator) -> tuple[list[str], str, Any, Case]:
    """Return the clock's cells, its name, its entry in a column map (or None), and the case with its expected result."""
    t, number = case.t, _number(layout, 6)
    if clock == "seconds":
        return [number(x) for x in t + g.uniform(0, 1000)], "t", None, case
    if clock == "epoch":
        return [number(x) for x in t + 1_764_000_000.0], "t", None, case
    if clock == "ms mapped":
        name = str(g.choice(["time_ms", "Time [ms]", "Zeit_ms"]))
        return [number(1000 * x) for x in t], name, {"column": name, "scale": 0.001}, case
    if clock == "ms as t":
        return [number(1000 * x) for x in t], "t", None, replace(case, t=1000 * t, clock_error=2e-3, bad_clock=True)
    if clock == "ns as t":
        cells = [str(1_764_000_000_000_000_000 + round(1e9 * x)) for x in t]
        return cells, "t", None, replace(case, codes=("bad_sample",), words=("scale",), must_refuse=True)
    if clock in ("Excel days", "MATLAB days"):
        first = {"Excel days": 46_083.427431, "MATLAB days": 739_678.25}[clock]
        return [_number(layout, 12)(first + x / 86_400) for x in t], "t", None, replace(case, clock_error=2e-5)
    if clock == "whole seconds":
        cells = [(START + datetime.timedelta(seconds=int(x))).strftime("%H:%M:%S") for x in t]
        return (
            cells,
            "t",
            None,
            replace(
                case,
                codes=("time_stamps", "bad_sample"),
                words=("whole seconds", "Write more digits"),
                must_refuse=True,
            ),
        )
    if clock == "rate":
        return [], "", {"rate_hz": float(1 / (t[1] - t[0]))}, replace(case, clock_error=1e-5)
    form = str(g.choice(STAMPS))
    if form == "German comma" and layout.separator == "," and not layout.quoted:
        form = "German"
    return [_stamp(form)(x) for x in t], "t", None, replace(case, described=f"{form}: {case.described}")


def _write_two_files(case: Case, layout: Layout, signals, rate: float, folder: Path) -> Case:
    """Write positions and forces at two rates into two files, each with its clock, and a map of both."""
    number = _number(layout, 9)
    late = np.arange(0.0, case.t[-1], 4 / rate) + 0.0007
    for name, kind, t in (("q.csv", "q_", case.t), ("f.csv", "tau_", late)):
        mine = {n: f(t) for n, f in signals.items() if n.startswith(kind)}
        layout.write(
            folder / name, ["t", *mine], [[number(x) for x in row] for row in np.column_stack([t, *mine.values()])]
        )
    entries: dict[str, Any] = {"files": {"q": "q.csv", "f": "f.csv"}, "t": {"file": "q", "column": "t"}}
    entries |= {n: {"file": "q" if n.startswith("q_") else "f", "column": n} for n in signals}
    (folder / "map.yaml").write_text(yaml.safe_dump(entries), encoding="utf-8")
    return replace(case, path=folder / "q.csv", names=("q.csv", "f.csv"), map=folder / "map.yaml", channels=dict(signals),
                   errors={n: 0.02 for n in signals})  # fmt: skip


def _write_topics(case: Case, layout: Layout, signals, rate: float) -> Case:
    """Write positions and forces of two topics into the rows of one file, as PlotJuggler exports them."""
    number = _number(layout, 9)
    late = np.arange(0.0, case.t[-1], 4 / rate) + 0.0003
    rows = [(t, "q_") for t in case.t] + [(t, "tau_") for t in late]
    values = {n: dict(zip(t, f(t), strict=True)) for n, f in signals.items() for t in [case.t if n[0] == "q" else late]}
    lines = [
        [number(t), *(number(values[n][t]) if n.startswith(kind) else "" for n in signals)] for t, kind in sorted(rows)
    ]
    layout.write(case.path, ["t", *signals], lines)
    return replace(case, channels=dict(signals), errors={n: 0.02 for n in signals})


def _write_rows_of_signals(case: Case, layout: Layout) -> Case:
    """Write one value a row with its signal's name, as databases export them."""
    number = _number(layout, 6)
    rows = [[number(t), n, number(x[k])] for k, t in enumerate(case.t) for n, x in case.channels.items()]
    layout.write(case.path, ["t", "topic", "value"], rows)
    return replace(case, codes=("file_format",), words=("pivot",), must_refuse=True)
