"""A payload from two recordings, units of one type, and what has changed on a running robot since when."""

from .change_detection import (
    BLOCK_S as BLOCK_S,
    FALSE_ALARMS_PER_HOUR as FALSE_ALARMS_PER_HOUR,
    ChangeDetector as ChangeDetector,
    DetectedChange as DetectedChange,
)
from .directions import Direction as Direction
from .fleet import (
    MIN_UNITS as MIN_UNITS,
    Fleet as Fleet,
    FleetParameter as FleetParameter,
    OutlyingUnit as OutlyingUnit,
    RandomEffects as RandomEffects,
    estimate_random_effects as estimate_random_effects,
    find_outlying_units as find_outlying_units,
    identify_fleet as identify_fleet,
)
from .follow import GrowingFile as GrowingFile
from .normal_state import BlockScore as BlockScore
from .payload import (
    FrictionDifference as FrictionDifference,
    PayloadEstimate as PayloadEstimate,
    PropertyEstimate as PropertyEstimate,
    identify_payload as identify_payload,
)
from .watch import (
    MIN_REFERENCE_S as MIN_REFERENCE_S,
    REFERENCE_S as REFERENCE_S,
    Watch as Watch,
    WatchResult as WatchResult,
    watch_logs as watch_logs,
)
