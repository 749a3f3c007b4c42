"""What section 6.3 of Dressler 2012 prints."""

DRIVES = {"cart1": (0.03527, 0.9647), "cart2": (0.03425, 0.9656), "cart3": (0.02748, 0.9728)}
"""Numerator and pole of (6.11), q^-5 b / (1 - a q^-1) at 4 ms."""
DRIVE_SAMPLES = 5
DRIVE_BANDWIDTH_HZ = 1.1
STEPS = (1.0e-3, 1.5e-3, 2.0e-3)  # m

TABLE_6_4 = {("x", "x"): (7.4, 7.4), ("x", "y"): (7.3, 7.5), ("y", "x"): (10.4, 10.7), ("y", "y"): (11.4, 11.5)}
"""Force and output direction -> lowest resonance [Hz]."""
EARLY_Y_UNDER_X = (11.4, 11.9)
"""In y under a push along x, before it turns into 7.3 to 7.5 Hz [Hz]."""

WITHOUT_WRIST = (14.0, 103.0)  # Hz
CENTRE_12TH_ORDER = 16.0  # Hz, of the closely spaced resonances
GAUGE_NOISE, TRACKER_NOISE = 1e-6, 1e-5  # m
ORDER_REFERENCE, ORDER_KINEMATICS, ORDER_TRACKER, ORDER_VISION = 7, 10, 12, 4
