"""What became of a case: an answer, a refusal in one sentence, or a fault of ours."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tau_dyn.exceptions import TauDynError

LONGEST_SENTENCE = 1000
"""Characters of a refusal; what is longer is no sentence."""


class Verdict(NamedTuple):
    """Outcome of one case: `answer`, `refused`, or a fault, with where it came up and what it said."""

    kind: str
    where: str = ""
    said: str = ""

    @property
    def fault(self) -> bool:
        """Whether it is a defect of ours."""
        return self.kind not in ("answer", "refused")


class Overdue(BaseException):
    """The case took longer than it may."""


def _ring(number: int, frame: object) -> None:
    raise Overdue


def judge(read: Callable[[Path], object], path: Path, seconds: float) -> Verdict:
    """Read one file and judge what comes of it.

    Args:
        read: Reader.
        path: File.
        seconds: CPU time [s] it may take; library code that never returns to Python is the parent's to end.
    """
    before = signal.signal(signal.SIGVTALRM, _ring)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        read(path)
        return Verdict("answer")
    except TauDynError as fault:
        return _refusal(fault)
    except Overdue as fault:
        return Verdict("hang", _where(fault), f"more than {seconds:g} s of CPU")
    except (Exception, SystemExit) as fault:
        return Verdict("crash", f"{type(fault).__name__} at {_where(fault)}", str(fault)[:300])
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _refusal(fault: TauDynError) -> Verdict:
    said = str(fault)
    if fault.exit_status not in (2, 3):
        return Verdict("crash", f"{type(fault).__name__} at {_where(fault)}", said[:300])
    if not said.strip() or len(said) > LONGEST_SENTENCE or not said.isprintable():
        return Verdict("no sentence", _where(fault), f"{len(said)} characters: {said[:300]}")
    return Verdict("refused", "", said)


def _where(fault: BaseException) -> str:
    """Return the last line of ours on the way to a fault."""
    frames = [f for f in traceback.extract_tb(fault.__traceback__) if "tau_dyn" in f.filename]
    last = frames[-1] if frames else traceback.extract_tb(fault.__traceback__)[-1]
    return f"{Path(last.filename).name}:{last.name}:{last.line}"[:160]
