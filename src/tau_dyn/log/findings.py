"""What a check of a log says: findings a person can act on, and numbers for a file.

A `Finding` is one sentence about one topic, with what would help. `fault` means that the log should not be used as it
is, `warning` that an answer will be poorer, `ok` that a thing was looked at and is fine, or why it was not looked at.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from tau_dyn.shown import Shown

Severity = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    severity: Severity
    topic: str
    sentence: str
    remedy: str = ""
    """What would help; empty where nothing has to."""


@dataclass(frozen=True)
class LogCheck(Shown):
    """The judgement of a log.

    Attributes:
        name: The log's name.
        findings: Everything that was looked at, in a fixed order of topics.
        numbers: The figures behind the sentences, plain numbers and lists for JSON; per-joint figures are mappings by
            joint.
    """

    name: str
    findings: tuple[Finding, ...]
    numbers: dict[str, Any]

    @property
    def fit_for_use(self) -> bool:
        """True where no finding is a fault."""
        return not any(finding.severity == "fault" for finding in self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are warnings or faults."""
        return tuple(finding.sentence for finding in self.findings if finding.severity != "ok")

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain data for JSON."""
        findings = [asdict(finding) for finding in self.findings]
        return {"name": self.name, "fit_for_use": self.fit_for_use, "findings": findings, "numbers": self.numbers}
