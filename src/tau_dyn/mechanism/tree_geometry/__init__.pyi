"""Dimensions of any tree as named parameters, its loops closed at other values, and how the tool moves with them."""

from .closure import (
    ClosedConfigurations as ClosedConfigurations,
    TreeClosure as TreeClosure,
    compute_open_rates as compute_open_rates,
    propagate_passive as propagate_passive,
    propagate_twists as propagate_twists,
)
from .dimensions import (
    PRIORITY as PRIORITY,
    Knob as Knob,
    TreeNumbers as TreeNumbers,
    TreeShape as TreeShape,
    build_rows as build_rows,
    compute_dimensions_at as compute_dimensions_at,
    get_shape as get_shape,
)
