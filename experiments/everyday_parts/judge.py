"""Compares the samples read from a file with the recorded ones."""

from __future__ import annotations

import numpy as np
from everyday_parts.case import Case

MAX_SENTENCE = 900
"""Longest refusal [characters]: a sentence with the columns of the file and a line of a map."""


def judge_case(case: Case, with_commands: bool = True) -> tuple[str, str]:
    """Return `read`, `refused` or `fault`, and why it is a fault; `with_commands` calls `check` and `columns` on any case."""
    from tau_dyn.exceptions import CannotAnswer, InputError
    from tau_dyn.log import check_log, propose_columns, read_log

    try:
        log = read_log(case.path, case.map)
    except (InputError, CannotAnswer) as refusal:
        sentence = str(refusal)
        if case.codes is None:
            return "fault", f"has to be read, and is refused: {sentence} [{refusal.code}]"
        if refusal.code not in case.codes:
            return "fault", f"refused with another code than {case.codes}: {sentence} [{refusal.code}]"
        if not any(name in sentence for name in case.names) or "\n" in sentence or len(sentence) > MAX_SENTENCE:
            return "fault", f"a refusal without its file, or of several lines: {sentence}"
        if case.words and not any(word in sentence for word in case.words):
            return "fault", f"a refusal without {' or '.join(case.words)}: {sentence}"
        return "refused", ""
    except Exception as error:  # noqa: BLE001 (the question of the study)
        return "fault", f"{type(error).__name__}: {error}"
    if case.must_refuse:
        return "fault", "has to be refused, and is read"
    if why := _compare(case, log):
        return "fault", why
    if not (with_commands or case.frozen or case.turns or case.bad_clock):
        return "read", ""
    try:
        findings = check_log(log).findings
        doubts = [f for f in findings if f.severity != "ok"]
        if case.frozen and not any(case.frozen in f.sentence for f in doubts):
            return "fault", f"a frozen encoder is called sound: {[f.sentence for f in findings if f.topic == 'signal']}"
        with_robot = check_log(log, case.robot).findings
        if case.turns and any(f.topic == "units" and f.severity != "ok" for f in with_robot):
            return "fault", "turns of a continuous joint are called another unit"
        if case.turns and not all("turns" in f.sentence for f in doubts if f.topic == "units"):
            return "fault", "without a robot, turns are not named"
        if case.bad_clock and not any(f.severity == "fault" and f.topic == "sampling" for f in doubts):
            return "fault", "milliseconds are called seconds"
        propose_columns(case.path, case.robot)
    except (InputError, CannotAnswer):
        pass
    except Exception as error:  # noqa: BLE001
        return "fault", f"check or columns: {type(error).__name__}: {error}"
    return "read", ""


def _compare(case: Case, log) -> str:
    """Return what differs from the truth; empty where nothing does."""
    is_interpolated = any(callable(values) for values in case.channels.values())
    if not is_interpolated:
        if log.n_samples != len(case.t):
            return f"{log.n_samples} samples instead of {len(case.t)}"
        off = float(np.max(np.abs((log.t - log.t[0]) - (case.t - case.t[0]))))
        if off > case.clock_error:
            return f"times are off by {off:.2g} s"
    for name, values in case.channels.items():
        if name not in log.channels:
            return f"{name} is not there: {sorted(log.channels)}"
        truth = values(log.t) if callable(values) else values
        wrong = float(np.max(np.abs(log.channels[name] - truth)))
        allowed = case.errors.get(name, 1e-6) * (float(np.ptp(truth)) if callable(values) else 1.0)
        if not wrong <= allowed:
            return f"{name} is off by {wrong:.2g}"
    return ""
