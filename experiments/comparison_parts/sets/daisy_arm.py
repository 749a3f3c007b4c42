"""DaISy's flexible robot arm: 1024 samples of a periodic sweep without a clock; the last 30 % are held out."""

from collections.abc import Iterator

import numpy as np

from comparison_parts.case import DATA, Case, split_in_time
from tau_dyn.log import Log


def read() -> Iterator[Case]:
    u, y = np.loadtxt(DATA / "daisy_robot_arm" / "robot_arm.dat").T
    train, held = split_in_time(Log(np.arange(float(len(u))), {"u0": u, "y0": y}, "robot_arm"))
    yield Case("DaISy arm", "vibration", train, held, inputs=("u0",), outputs=("y0",), order=4, origin="KU Leuven")
