"""Commands that leave a resonance at rest: input shapers and notch filters."""

from .notch import CausalNotch as CausalNotch, design_causal_notch as design_causal_notch
from .resonance import Resonance as Resonance, read_resonances as read_resonances
from .shapers import (
    SHAPERS as SHAPERS,
    Shaper as Shaper,
    combine_shapers as combine_shapers,
    compute_residual_vibration as compute_residual_vibration,
    design_shaper as design_shaper,
)
