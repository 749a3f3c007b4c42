"""Public data sets, one a file: where it is, how it is read, its fixed split, what is known of it. Each yields `Case`s."""

from collections.abc import Callable, Iterator

from comparison_parts.case import Case
from comparison_parts.sets import (
    daisy_arm,
    double_pendulum,
    emps,
    kr300,
    simple_pendulum,
    simulated_arm,
    so101,
    tx40,
    vibration,
    xl330,
)

SETS: dict[str, Callable[[], Iterator[Case]]] = {
    module.__name__.rsplit(".", 1)[-1]: module.read
    for module in (
        emps, tx40, kr300, double_pendulum, simple_pendulum, so101, xl330, daisy_arm, vibration, simulated_arm,
    )
}  # fmt: skip
