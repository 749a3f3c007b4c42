"""How well do default models simulate five public sets, beside SLICOT's fixed orders?

    python experiments/vibration_sets.py [--only evaporator ...]

In: the sets of the DaISy collection in `$TAU_DYN_DATA/vibration` (by default `../shared/data`). Out, printed: method, order,
delay, fit on the last 30 % and seconds, beside the fit that SLICOT's subspace method reaches at the order in brackets.
"""

import argparse
import time

from comparison_parts.sets.vibration import SETS, read_set

from tau_dyn.modes import find_modes


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
