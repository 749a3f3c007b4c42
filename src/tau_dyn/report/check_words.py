"""What a colleague would say about the check of a log: whether it may be used, what was found, worst first."""

from __future__ import annotations

from tau_dyn.log import CheckFinding, LogCheck
from tau_dyn.report.formatting import count

_ORDER = ("fault", "warning", "ok")


def order_worst_first(checked: LogCheck) -> list[CheckFinding]:
    """Return all findings, faults before warnings before what is fine."""
    return sorted(checked.findings, key=lambda f: _ORDER.index(f.severity))


def describe_check(finding: CheckFinding, name: str) -> str:
    """Return a finding's sentence without the log's name in front."""
    return finding.sentence.removeprefix(f"{name}: ")


def check_headline(checked: LogCheck, name: str = "") -> str:
    """Return whether a log may be used, in a sentence; with a name it is the sentence's subject."""
    faults = sum(f.severity == "fault" for f in checked.findings)
    doubts = sum(f.severity == "warning" for f in checked.findings)
    start, fit, not_fit = (f"{name} is ", "usable", "not usable") if name else ("", "Usable", "Not usable")
    if not checked.fit_for_use:
        more = f", {count(doubts, 'warning')}" if doubts else ""
        return f"{start}{not_fit}: {count(faults, 'fault')}{more}."
    return f"{start}{fit}, with {count(doubts, 'warning')}." if doubts else f"{start}{fit}."
