"""How well do default models simulate five public sets, beside SLICOT's fixed orders?

    python experiments/vibration_sets.py [--only evaporator ...]

In: the sets of the DaISy collection in `$TAU_DYN_DATA/vibration` (by default `../shared/data`). Out, printed: method, order,
delay, fit on the last 30 % and seconds, beside the fit that SLICOT's subspace method reaches at the order in brackets.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from tau_dyn.log import Log
from tau_dyn.modes import find_modes

DATA = Path(os.environ.get("TAU_DYN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "vibration"
SETS = {
    "CD_player_arm": (0, 2, 2, 76.7, 8), "cstr": (1, 1, 2, 87.8, 5), "evaporator": (0, 3, 3, 56.9, 4),
    "exchanger": (1, 1, 1, 58.5, 4), "steamgen": (1, 4, 4, 70.6, 9),
}  # fmt: skip
"""Leading columns to leave out, inputs, outputs, SLICOT's fit [%] and its order."""


def read_set(name: str) -> Log:
    """Return a set as a log with columns u0, u1, .. and y0, y1, .., a sample a second."""
    first, n_inputs, n_outputs, _, _ = SETS[name]
    x = loadmat(DATA / f"{name}_dat.mat")[f"{name}_dat"]
    columns = {f"u{k}": x[:, first + k] for k in range(n_inputs)}
    columns |= {f"y{k}": x[:, first + n_inputs + k] for k in range(n_outputs)}
    return Log(np.arange(len(x), dtype=float), columns, name=name)


def main(names: list[str]) -> None:
    for name in names:
        _, n_inputs, n_outputs, slicot, order = SETS[name]
        began = time.perf_counter()
        found = find_modes(read_set(name), [f"u{k}" for k in range(n_inputs)], [f"y{k}" for k in range(n_outputs)])
        result, seconds = found.to_dict(), time.perf_counter() - began
        print(
            f"{name}: {result['method']} order {result['order']} delay {result['delay_samples']} "
            f"fit {result['fit_percent']['holdout']:.1f} % (SLICOT {slicot} % at {order}) {seconds:.0f} s", flush=True
        )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SETS, default=list(SETS))
    main(parser.parse_args().only)
