"""What a check of a log says: findings a person can act on, and numbers for a file.

A `CheckFinding` is one sentence about one topic, with what would help. `fault` means that the log should not be used as it
is, `warning` that an answer will be poorer, `ok` that a thing was looked at and is fine, or why it was not looked at.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from tau_dyn.coded_warning import CodedWarning, get_code
from tau_dyn.results import Shown

Severity = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class CheckFinding:
    """One thing that was looked at."""

    severity: Severity
    topic: str
    sentence: str
    remedy: str = ""
    """What would help; empty where nothing has to."""
    code: str = ""
    """Stable code, see docs/reference/message_codes.md; empty where there is none."""


def build_fault(warning: str) -> CheckFinding:
    """Return a coded warning as a fault of the log; its sentence holds the remedy."""
    return CheckFinding("fault", "integrity", str(warning), code=get_code(warning))


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
    findings: tuple[CheckFinding, ...]
    numbers: dict[str, Any]

    @property
    def fit_for_use(self) -> bool:
        """True where no finding is a fault."""
        return not any(finding.severity == "fault" for finding in self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are warnings or faults."""
        doubtful = [finding for finding in self.findings if finding.severity != "ok"]
        return tuple(CodedWarning(f.code, f.sentence) if f.code else f.sentence for f in doubtful)

    def with_faults(self, warnings: Iterable[str]) -> "LogCheck":
        """Return the check with what a robot file says against the log: coded warnings, as further faults."""
        sentence = f"{self.name}: wiring and the time of the forces were held against the masses of the robot file."
        judged = CheckFinding("ok", "synchronisation", sentence)
        kept = [f for f in self.findings if (f.topic, f.severity) != ("synchronisation", "ok")]
        faults = [build_fault(warning) for warning in warnings]
        return replace(self, findings=(*kept, judged, *(f for f in faults if f not in kept)))

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain data for JSON."""
        findings = [{k: x for k, x in asdict(f).items() if k != "code" or x} for f in self.findings]
        return {"name": self.name, "fit_for_use": self.fit_for_use, "findings": findings, "numbers": self.numbers}
