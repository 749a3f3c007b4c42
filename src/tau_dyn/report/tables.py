"""What the terminal shows: one sentence, error by joint, the parameters, what is uncertain, and where things are.

Colour carries meaning only (weak values dim, the verdict's level), and disappears when the output is piped. Everything is
plain text to the console, never markup, so that no name can style it. Tables fit 80 columns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from tau_dyn.identify import Identification
from tau_dyn.log import Log, LogCheck
from tau_dyn.report.rows import Row, parameter_rows
from tau_dyn.report.trust import combinations, summary_words
from tau_dyn.report.words import check_headline, headline, listed, number, percent, pretty_unit, verdict

MARGIN = (0, 0, 0, 2)
LEVEL_STYLE = {"good": "green", "care": "yellow", "poor": "bold red"}
SEVERITY_STYLE = {"ok": "green", "warning": "yellow", "fault": "bold red"}
BAR = 24
_EIGHTHS = " ▏▎▍▌▋▊▉█"


def print_identification(
    console: Console,
    found: Identification,
    written: Mapping[str, str] | None = None,
    *,
    truth: Mapping[str, float] | None = None,
) -> None:
    """Print an identification for a person.

    Args:
        console: Where to.
        found: The result.
        written: What was written, such as `{"model": "m.yaml"}`, for the last line.
        truth: True values by name, where the data were made; they replace the nominal ones in the table.
    """
    judged = verdict(found, truth)
    _say(console, f"{found.model.robot.name} · {summary_words(found)}", "dim")
    _say(console, headline(found, truth), "bold")
    _say(console, judged.sentence, LEVEL_STYLE[judged.level])
    _put(console, _error_table(found, _room(console)))
    _put(console, _parameter_table(parameter_rows(found), truth or {}))
    for title, sentences in _uncertain(found):
        _say(console, f"{title}: {'; '.join(sentences)}.")
    if written:
        _say(console, "   ".join(f"{what} → {path}" for what, path in written.items()))


def print_check(console: Console, log: Log, checked: LogCheck) -> None:
    """Print the check of a log for a person: the judgement, then what was found, worst first."""
    joints = ", ".join(log.joints("q")) or "no joint"
    _say(console, f"{log.name} · {number(log.duration, 4)} s at {number(log.rate_hz, 4)} Hz · {joints}", "dim")
    faults = sum(f.severity == "fault" for f in checked.findings)
    doubts = sum(f.severity == "warning" for f in checked.findings)
    style = SEVERITY_STYLE["fault" if faults else "warning" if doubts else "ok"]
    _say(console, check_headline(checked), f"bold {style}")
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    order = {"fault": 0, "warning": 1, "ok": 2}
    fine = Counter(f.topic for f in checked.findings if f.severity == "ok")
    shown: set[str] = set()
    for finding in sorted(checked.findings, key=lambda f: order[f.severity]):
        text = finding.sentence.removeprefix(f"{checked.name}: ")
        if finding.severity == "ok":
            if finding.topic in shown:
                continue
            shown.add(finding.topic)
            text += f" ({fine[finding.topic] - 1} more alike)" if fine[finding.topic] > 1 else ""
        elif finding.remedy:
            text += f"\n→ {finding.remedy}"
        table.add_row(
            _plain(finding.severity, SEVERITY_STYLE[finding.severity]), _plain(finding.topic, "dim"), _plain(text)
        )
    _put(console, table)


def _error_table(found: Identification, room: int) -> Table:
    judged, units = found.holdout or found.train, found.model.robot.force_units
    table = _table()
    table.add_column("error by joint", no_wrap=True)
    table.add_column("")
    for title in ("held out" if found.holdout else "of the fit", "rms", *(("training",) if found.holdout else ())):
        table.add_column(title, justify="right", no_wrap=True)
    worst = max(judged.per_joint_percent, default=1.0) or 1.0
    width = BAR if room >= 90 else 16
    for k, joint in enumerate(judged.joints):
        share = float(judged.per_joint_percent[k])
        cells = [
            joint,
            _meter(share / worst, width),
            percent(share),
            f"{number(float(judged.rms[k]), 3)} {pretty_unit(units[k])}",
        ]
        cells += [percent(float(found.train.per_joint_percent[k]))] if found.holdout else []
        table.add_row(*map(_plain, cells))
    return table


def _parameter_table(rows: list[Row], truth: Mapping[str, float]) -> Table:
    table = _table()
    table.add_column("parameter", no_wrap=True)
    table.add_column("estimate", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("95 % interval", justify="right", no_wrap=True)
    if truth or any(r.nominal for r in rows):
        table.add_column("true" if truth else "nominal", justify="right", no_wrap=True)
    for r in rows:
        last = (number(truth[r.name], 5) if r.name in truth else "") if truth else r.nominal
        cells = [r.name, r.estimate, r.unit, r.interval or "not seen alone", last]
        style = "" if r.state == "known" else "dim"
        table.add_row(*(_plain(c, style) for c in cells[: len(table.columns)]))
    return table


def _uncertain(found: Identification) -> list[tuple[str, list[str]]]:
    """Return headings and what stands under them, empty ones left out."""
    rows = found.rows()
    weak = [r["name"] for r in rows if r["stderr"] is not None and not r["determined"]]
    unseen = [r["name"] for r in rows if r["stderr"] is None and not r.get("depends_on")]
    groups = [
        ("Not determined by these data", [listed(weak)] if weak else []),
        ("Seen only together", combinations(found)[:4]),
        ("Not shown at all (nominal values)", [listed(unseen)] if unseen else []),
        ("Fits exactly as well", list(found.equivalent[:1]) + _more(found.equivalent)),
    ]
    return [(title, sentences) for title, sentences in groups if sentences]


def _more(sentences: tuple[str, ...]) -> list[str]:
    return [f"likewise for {len(sentences) - 1} more"] if len(sentences) > 1 else []


def _table() -> Table:
    return Table(box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0), pad_edge=False, show_edge=False, header_style="dim")


def _meter(share: float, width: int) -> str:
    eighths = max(1, round(8 * width * min(max(share, 0.0), 1.0)))
    return "█" * (eighths // 8) + (_EIGHTHS[eighths % 8] if eighths % 8 else "")


def _plain(text: str, style: str = "") -> Text:
    """Return text without control characters, which a file name could use to steer the terminal."""
    return Text("".join(c if c.isprintable() or c == "\n" else "�" for c in text), style)


def _room(console: Console) -> int:
    return min(console.width, 100)


def _say(console: Console, text: str, style: str = "") -> None:
    _put(console, _plain(text, style))


def _put(console: Console, what: Text | Table) -> None:
    console.print()
    options = console.options.update(width=_room(console))
    for line in console.render_lines(Padding(what, MARGIN, expand=False), options, pad=False):
        console.print(Segments([*_trimmed(line), Segment.line()]), end="", no_wrap=True, crop=False)


def _trimmed(line: list[Segment]) -> list[Segment]:
    """Return a line without the blanks at its end."""
    line = list(line)
    while line and not line[-1].text.strip():
        line.pop()
    return [*line[:-1], Segment(line[-1].text.rstrip(), line[-1].style)] if line else []
