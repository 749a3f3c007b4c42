"""Two models, results or runs beside each other: what changed, and whether by more than their uncertainty."""

from .comparison import (
    Change as Change,
    Comparison as Comparison,
    ErrorChange as ErrorChange,
    FindingChange as FindingChange,
    compare as compare,
)
from .read import ComparedSide as ComparedSide, read_side as read_side
from .run import (
    REPORT as REPORT,
    RESULT as RESULT,
    RUN as RUN,
    CircumstanceDifference as CircumstanceDifference,
    InputChange as InputChange,
    RecordedRun as RecordedRun,
    is_run as is_run,
    read_run as read_run,
)
