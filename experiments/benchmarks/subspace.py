"""Speed and accuracy of subspace identification beside other packages, in one run.

A structure with resonances at 7.4, 11.5, 14 and 103 Hz, three forces in, three displacements out, 40 dB, sampled at 250
Hz; every method gets the same samples, order 8 and the same horizon. Each peer runs in a process of its own with a time
limit, and is skipped with a line where it is not installed (`pip install ctrlsys nfoursid sippy-unipi llsi`).

    python experiments/benchmarks/subspace.py --samples 500000 --horizon 60 --limit 120

Traps: `ctrlsys.ib01cd(job='D')` overwrites the caller's `u`; the factor of `ib01ad('M')` must not go into
`ib01bd('N')`; nfoursid builds a projector of N by N; sippy's `sippy` on the package index is a telephone stack.
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import resource
import time
import warnings
from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

DT, ORDER = 1 / 250, 8
FREQUENCIES, DAMPINGS = (7.4, 11.5, 14.0, 103.0), (0.01, 0.02, 0.03, 0.015)
Poles = np.ndarray


def data(n_samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and outputs (N, 3)."""
    rng = np.random.default_rng(seed)
    shapes = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    w, zeta = 2 * np.pi * np.array(FREQUENCIES), np.array(DAMPINGS)
    A = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.diag(w**2), -np.diag(2 * zeta * w)]])
    B = np.vstack([np.zeros((4, 3)), shapes[:3].T])
    held = expm(np.block([[A, B], [np.zeros((3, 11))]]) * DT)
    from tau_dyn.modes.state_space import simulate_states

    u = rng.normal(size=(n_samples, 3))
    y = simulate_states(held[:8, :8], u @ held[:8, 8:].T, np.zeros(8))[:, :4] @ shapes[:3].T
    return u, y + 0.01 * y.std(axis=0) * rng.normal(size=y.shape)


def tau_dyn_ac(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """A and C only."""
    factors = _ours(u, y, horizon)
    return np.linalg.eigvals(factors.dynamics(ORDER)[0])


def tau_dyn_all(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """A, B, C, D and K."""
    return _ours(u, y, horizon).model(ORDER, direct=True).poles()


def tau_dyn_refined(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """The same and refinement with standard errors."""
    from tau_dyn.modes import refine

    factors = _ours(u, y, horizon)
    return refine(factors.model(ORDER, direct=False), [_record(u, y)]).model.poles()


def _record(u: np.ndarray, y: np.ndarray):
    from tau_dyn.modes import Record

    return Record(u, y, DT, ("a", "b", "c"), ("x", "y", "z"))


def _ours(u: np.ndarray, y: np.ndarray, horizon: int):
    from tau_dyn.modes import compress_subspace_data

    return compress_subspace_data([_record(u, y)], horizon=horizon)


def slicot(algorithm: str, job: str) -> Callable[[np.ndarray, np.ndarray, int], Poles]:
    """SLICOT through ctrlsys: IB01AD and IB01BD, by MOESP."""

    def run(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
        import ctrlsys

        u, y = np.asfortranarray(u.copy()), np.asfortranarray(y.copy())
        found = ctrlsys.ib01ad("M", algorithm, "M", "O", "N", "N", horizon, 3, 3, u, y, 0.0, 0.0)
        assert found[-1] == 0, f"ib01ad: info {found[-1]}"
        model = ctrlsys.ib01bd("M", job, "N", horizon, ORDER, 3, 3, len(u), found[1], 0.0)
        assert model[-1] == 0, f"ib01bd: info {model[-1]}"
        return np.linalg.eigvals(model[0])

    return run


def nfoursid(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """The package nfoursid."""
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    names = [f"u{k}" for k in range(3)], [f"y{k}" for k in range(3)]
    frame = pd.DataFrame(np.hstack([u, y]), columns=names[0] + names[1])
    found = NFourSID(frame, output_columns=names[1], input_columns=names[0], num_block_rows=horizon)
    found.subspace_identification()
    return np.linalg.eigvals(found.system_identification(rank=ORDER)[0].a)


def sippy(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """The package sippy-unipi, CVA."""
    from sippy_unipi import system_identification

    found = system_identification(y.T, u.T, "CVA", SS_f=horizon, SS_p=horizon, SS_fixed_order=ORDER)
    return np.linalg.eigvals(found.A)


def llsi(u: np.ndarray, y: np.ndarray, horizon: int) -> Poles:
    """The package llsi, N4SID (its own horizon)."""
    from llsi import SysIdData, sysid

    signals = {f"u{k}": u[:, k] for k in range(3)} | {f"y{k}": y[:, k] for k in range(3)}
    found = sysid(
        SysIdData(Ts=DT, **signals), [f"y{k}" for k in range(3)], [f"u{k}" for k in range(3)], ORDER, method="n4sid"
    )
    return np.linalg.eigvals(found.A)


METHODS: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray, int], Poles]]] = {
    "tau_dyn, A and C": ("tau_dyn", tau_dyn_ac),
    "tau_dyn, A to K": ("tau_dyn", tau_dyn_all),
    "tau_dyn, refined": ("tau_dyn", tau_dyn_refined),
    "SLICOT fast QR, A and C": ("ctrlsys", slicot("F", "C")),
    "SLICOT Cholesky, A and C": ("ctrlsys", slicot("C", "C")),
    "SLICOT Cholesky, A to D": ("ctrlsys", slicot("C", "A")),
    "nfoursid": ("nfoursid", nfoursid),
    "sippy-unipi": ("sippy_unipi", sippy),
    "llsi": ("llsi", llsi),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--horizon", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for each method")
    parser.add_argument("--memory", type=float, default=16.0, help="GiB of address space for each method")
    parser.add_argument("--only", nargs="+", default=list(METHODS))
    options = parser.parse_args()
    print(f"N = {options.samples}, s = {options.horizon}, 3 x 3, order {ORDER}, 40 dB, seed {options.seed}")
    print(f"{'':26s} {'wall [s]':>9s} {'CPU [s]':>9s} {'MB added':>9s}  largest error of frequency, of damping")
    for name in options.only:
        print(f"{name:26s} {_isolated(name, options)}", flush=True)


def _isolated(name: str, options: argparse.Namespace) -> str:
    """Run a method in a process of its own; return its line."""
    if importlib.util.find_spec(METHODS[name][0]) is None:
        return "skipped: not installed"
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(name, options, theirs))
    process.start()
    theirs.close()
    try:
        made = ours.recv() if ours.poll(options.limit + 60) else None  # importing and making data take their time
        if made == "ready":
            line = ours.recv() if ours.poll(options.limit) else f"not done in {options.limit:.0f} s"
        else:
            line = "not even its data in time"
    except EOFError:
        line = "died (out of memory?)"
    process.kill()
    process.join()
    return line


def _run(name: str, options: argparse.Namespace, pipe) -> None:
    warnings.simplefilter("ignore")
    u, y = data(options.samples, options.seed)
    small = slice(0, 3000)
    method = METHODS[name][1]
    try:
        method(u[small], y[small], 20)  # imports and compilers are not what is compared
    except Exception:
        pass
    resource.setrlimit(resource.RLIMIT_AS, (int(options.memory * 2**30),) * 2)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    pipe.send("ready")
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        poles = method(u, y, options.horizon)
    except Exception as problem:  # a peer's failure is a line of the table
        pipe.send(f"failed: {type(problem).__name__}: {str(problem).splitlines()[0][:70] if str(problem) else ''}")
        return
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    added = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    pipe.send(f"{wall:9.2f} {cpu:9.2f} {added:9.0f}  {_errors(poles)}")


def _errors(poles: Poles) -> str:
    s = np.log(poles.astype(complex)) / DT
    s = s[s.imag > 0]
    if len(s) == 0:
        return "no resonance"
    found = np.column_stack([np.abs(s) / (2 * np.pi), -s.real / np.abs(s)])
    nearest = [found[int(np.argmin(np.abs(found[:, 0] - f)))] for f in FREQUENCIES]
    error = np.abs(np.array(nearest) / np.column_stack([FREQUENCIES, DAMPINGS]) - 1).max(axis=0)
    unstable = " unstable" if np.abs(poles).max() >= 1 else ""
    return f"{100 * error[0]:9.5f} % {100 * error[1]:9.3f} %{unstable}"


if __name__ == "__main__":
    main()
