"""What the terminal shows of the check of a log: the judgement, then what was found, worst first."""

from __future__ import annotations

from collections import Counter

from rich.console import Console
from rich.table import Table

from tau_dyn.log import Log, LogCheck
from tau_dyn.report.check_words import check_headline, describe_check, order_worst_first
from tau_dyn.report.formatting import format_number
from tau_dyn.report.terminal import escape_control_characters, put, say

SEVERITY_STYLE = {"ok": "green", "warning": "yellow", "fault": "bold red"}


def print_check(console: Console, log: Log, checked: LogCheck) -> None:
    """Print the check of a log for a person: the judgement, then what was found, worst first."""
    joints = ", ".join(log.joints("q")) or "no joint"
    say(
        console,
        f"{log.name} · {format_number(log.duration, 4)} s at {format_number(log.rate_hz, 4)} Hz · {joints}",
        "dim",
    )
    faults = sum(f.severity == "fault" for f in checked.findings)
    doubts = sum(f.severity == "warning" for f in checked.findings)
    style = SEVERITY_STYLE["fault" if faults else "warning" if doubts else "ok"]
    say(console, check_headline(checked), f"bold {style}")
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    fine = Counter(f.topic for f in checked.findings if f.severity == "ok")
    shown: set[str] = set()
    for finding in order_worst_first(checked):
        text = describe_check(finding, checked.name)
        if finding.severity == "ok":
            if finding.topic in shown:
                continue
            shown.add(finding.topic)
            text += f" ({fine[finding.topic] - 1} more alike)" if fine[finding.topic] > 1 else ""
        elif finding.remedy:
            text += f"\n→ {finding.remedy}"
        table.add_row(
            escape_control_characters(finding.severity, SEVERITY_STYLE[finding.severity]),
            escape_control_characters(finding.topic, "dim"),
            escape_control_characters(text),
        )
    put(console, table)
