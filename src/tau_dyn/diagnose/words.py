"""The answer in one or two sentences."""

from __future__ import annotations

from collections.abc import Sequence

from tau_dyn.diagnose.result import Finding, OutputErrors, Unexplained, Verdict

_MAX_LISTED = 3  # causes that a sentence names


def describe_verdict(
    verdict: Verdict,
    findings: Sequence[Finding],
    unexplained: Sequence[Unexplained],
    before: OutputErrors,
    after: OutputErrors,
) -> str:
    """Return the answer in one or two sentences."""
    missed = f"The residual of the refitted model is {before.relative_error_percent:.2g} % of the measured force"
    confirmed = [f for f in findings if f.status == "confirmed"]
    if confirmed:
        text = f"{missed}; with {_listed(confirmed)} it is {after.relative_error_percent:.2g} %."
        text += "".join(f" {f.sentence}" for f in findings if f.status == "parameter" and f.cause == "payload")
    elif verdict in ("named", "cannot_tell"):
        f = next(f for f in findings if f.status == "parameter")
        text = f"{missed}. {f.sentence}"
        if verdict == "cannot_tell":
            text += f" Indistinguishable with these data: {f.cause} and {', '.join(f.indistinguishable_from)}."
    elif verdict == "nothing_found":
        text = f"{missed}. No model error was detected."
    else:
        text = f"{missed}."
    if any(u.status == "confirmed" for u in unexplained):
        u = unexplained[0]
        what = ", ".join(u.depends_on)
        share = f"{100 * u.share_of_residual_variance:.0f} % of its residual"
        text += f" Significant unexplained structure at {u.joint} depends on {what} ({share})."
    return text


def _listed(findings: Sequence[Finding]) -> str:
    """Return causes with their joints, at most three of them."""
    said = [f"{f.cause.replace('_', ' ')} ({', '.join(f.joints)})" for f in findings[:_MAX_LISTED]]
    if len(findings) > _MAX_LISTED:
        said.append(f"{len(findings) - _MAX_LISTED} more")
    return said[0] if len(said) == 1 else f"{', '.join(said[:-1])} and {said[-1]}"
