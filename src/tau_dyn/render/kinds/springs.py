"""Springs of a robot from vibration records: stiffness and damping with errors, and how well they explain each record."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tau_dyn import results as r
from tau_dyn.modes import FittedSpring, RecordFit, SpringFit
from tau_dyn.render.presentation import present_kind, warn

GOOD_FIT = 90.0
"""Fit of every record's best output from which the springs count as the whole explanation [%]."""
BADGES = {"good": "Use it", "care": "Use with care", "poor": "Do not rely on it"}


@present_kind.register
def present_springs(found: SpringFit, *, logs: Sequence[tuple[str, str]] = ()) -> r.Presentation:
    """Return the presentation of fitted springs.

    Args:
        found: The result.
        logs: Name and hash of every log.
    """
    sections = [
        *warn([r.end_sentence(r.capitalise(str(text))) for text in found.warnings]),
        r.Chapter("springs", "Springs", lambda: _build_springs(found), r.On.ALL),
        r.Chapter("records", "Records", lambda: _build_records(found), r.On.ALL),
    ]
    inputs = (
        f"{r.count(len(found.records), 'record')}, {r.count(len(found.inputs), 'input')} ({r.format_list(found.inputs)}), "
        f"{r.count(len(found.outputs), 'output')} ({r.format_list(found.outputs)}); geometry and masses as in the robot file."
    )
    return r.Presentation(
        "Springs of", found.robot.name, f"{found.robot.name}: springs", describe_headline(found), describe_verdict(found), inputs,
        sections, found.warnings,
        provenance=r.Provenance(
            [("method", "maximum likelihood in the frequency domain")], [("log", name, sha or "not a file") for name, sha in logs]
        ),
        data=lambda: found.to_dict()["springs"], result=found,
    )  # fmt: skip


def describe_headline(found: SpringFit) -> str:
    """Return how many springs the records determine."""
    known, all_of_them = len(found.list_identified()), len(found.springs)
    return f"{known} of {r.count(all_of_them, 'spring')} identified from {r.count(len(found.records), 'record')}."


def describe_verdict(found: SpringFit) -> r.Verdict:
    """Return the verdict on the use of the springs: by held-out records, or else by the records of the fit."""
    judged = [x for x in found.records if x.held_out] or list(found.records)
    worst = min(max(x.fit_percent) for x in judged)
    of = "held-out records" if judged[0].held_out else "the records of the fit"
    fit = f"the springs explain at least {worst:.1f} % of the best output of {of}".replace("-", "\u2212")
    if worst < GOOD_FIT or not found.converged:
        why = fit if found.converged else f"the fit did not converge; {fit}"
        return r.judge("poor" if worst < GOOD_FIT / 2 else "care", f"{r.capitalise(why)}.", BADGES)
    if weak := found.list_not_identified():
        named = r.format_list(weak)
        return r.judge("care", f"{r.capitalise(fit)}; no record determines {named}.", BADGES)
    return r.judge("good", f"{r.capitalise(fit)}.", BADGES)


def _build_springs(found: SpringFit) -> Iterator[r.Element]:
    yield r.tabulate_things(
        found.springs,
        r.Column("spring", cell=lambda s: f"{s.spring.joint}{' (drive)' if s.of_drive else ''}"),
        r.Column("stiffness", "number", "big", cell=_format_stiffness),
        r.Column("95 % interval", "number", spare=True, cell=_format_interval),
        r.Column("damping", "number", cell=_format_damping),
        r.Column(
            "in the file",
            "number",
            cell=lambda s: "" if s.nominal is None else f"{r.format_number(s.nominal, 4)} {s.unit}",
        ),
        state=lambda s: "" if s.identified else "weak",
        on=r.On.ALL,
    )
    yield r.explain("\u00b1 is one standard error (1 \u03c3). Weak rows: no record determines this stiffness to 30 %.")


def _format_stiffness(s: FittedSpring) -> str:
    if not s.identified:
        return f"not identified ({r.format_number(s.spring.stiffness, 1)} {s.unit})"
    return r.format_with_uncertainty(s.spring.stiffness, s.stiffness_stderr, s.unit)


def _format_interval(s: FittedSpring) -> str:
    return r.format_interval(s.ci95, s.stiffness_stderr) if s.identified else ""


def _format_damping(s: FittedSpring) -> str:
    return (
        r.format_with_uncertainty(s.spring.damping, s.damping_stderr, s.unit.replace("/", " s/"))
        if s.identified
        else ""
    )


def _build_records(found: SpringFit) -> Iterator[r.Element]:
    def pose(x: RecordFit) -> str:
        return ", ".join(r.format_number(v, 3) for v in x.q)

    yield r.tabulate_things(
        found.records,
        r.Column("record", cell=lambda x: f"{x.log}{' (held out)' if x.held_out else ''}"),
        r.Column("pose", cell=pose),
        r.Column("fit of the outputs [%]", "number", cell=lambda x: ", ".join(f"{v:.1f}" for v in x.fit_percent)),
        r.Column(
            "resonances [Hz]", "number", cell=lambda x: ", ".join(r.format_number(v, 4) for v in x.resonances_hz[:5])
        ),
        on=r.On.ALL,
    )
