"""Black-box engines on structures whose resonances are known, and on a measured arm."""

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code
from scipy.linalg import expm

from tau_dyn.modes import Record, StateSpace, compress_subspace_data, refine
from tau_dyn.modes.hankel import arx, compress
from tau_dyn.modes.methods import compute_gramians, compute_root, decompose_pulse_tests, era, reduce_order
from tau_dyn.modes.modal import find_resonances
from tau_dyn.modes.record import Scales
from tau_dyn.modes.state_space import estimate_initial_state, predict, simulate, simulate_states
from tau_dyn.modes.subspace import pbsid

DT = 1 / 200
FREQUENCIES, DAMPINGS = (7.4, 11.5, 14.0), (0.01, 0.02, 0.03)


def structure(seed: int = 0, output: str = "displacement", n_inputs: int = 2, n_outputs: int = 2) -> StateSpace:
    """Three modes with orthonormal shapes, forces held over each sample."""
    shapes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    w, zeta = 2 * np.pi * np.array(FREQUENCIES), np.array(DAMPINGS)
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag(w**2), -np.diag(2 * zeta * w)]])
    B = np.vstack([np.zeros((3, n_inputs)), shapes[:n_inputs].T])
    pick = {"displacement": np.eye(6)[:3], "velocity": np.eye(6)[3:], "acceleration": A[3:]}[output]
    C, D = shapes[:n_outputs] @ pick, np.zeros((n_outputs, n_inputs))
    if output == "acceleration":
        D = shapes[:n_outputs] @ shapes[:n_inputs].T
    held = expm(np.block([[A, B], [np.zeros((n_inputs, 6 + n_inputs))]]) * DT)
    return StateSpace(held[:6, :6], held[:6, 6:], C, D, np.zeros((6, n_outputs)), DT)


def shaken(model: StateSpace, n: int, seed: int, noise: float = 0.01, x0: np.ndarray | None = None) -> Record:
    """White forces; white noise of a part of every output's standard deviation."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, model.B.shape[1]))
    empty = Record(u, np.zeros((n, len(model.C))), model.dt, ("a", "b"), ("c", "d"))
    y = simulate(model, empty, np.zeros(model.order) if x0 is None else x0)
    return replace(empty, y=y + noise * y.std(axis=0) * rng.normal(size=y.shape))


def check(model: StateSpace, frequency: float = 1e-3, damping: float = 0.05) -> None:
    """Compare relative errors of all resonances with limits."""
    found = find_resonances(model)
    assert len(found) == 3
    assert np.allclose([mode.frequency_hz for mode in found], FREQUENCIES, rtol=frequency)
    assert np.allclose([mode.damping_ratio for mode in found], DAMPINGS, rtol=damping)


@pytest.mark.parametrize("weighting", ["cva", "moesp", "n4sid"])
def test_subspace_finds_the_resonances_of_a_shaken_structure(weighting):
    """With 40 dB of noise all weightings see the modes, and the simulated output is the measured one but for the noise."""
    record = shaken(structure(), 6000, 1)
    model = compress_subspace_data([record], horizon=30).model(6, weighting)
    check(model)
    residual = record.y - simulate(model, record)
    assert np.all(residual.std(axis=0) < 0.012 * record.y.std(axis=0))
    assert not model.D.any()  # displacements do not answer within the sample


def test_factor_of_the_correlations_is_that_of_the_rows_themselves():
    """The displacement structure gives the same products as the Hankel matrix written out, over two records."""
    records = [shaken(structure(), 400, 2), shaken(structure(), 150, 3)]
    fast, slow = compress(records, 12, "gram"), compress(records, 12, "qr")
    windows = [np.hstack([r.u, r.y])[k : k + 12].ravel() for r in records for k in range(r.n_samples - 11)]
    Z = np.array(windows)
    direct = Z.T @ Z / len(Z)
    assert fast.n_columns == len(Z)
    assert np.allclose(fast.L @ fast.L.T, direct, rtol=1e-9, atol=1e-12 * direct.max())
    assert np.allclose(slow.L @ slow.L.T, direct, rtol=1e-9, atol=1e-12 * direct.max())


def test_noise_free_data_fall_back_to_qr_and_give_the_plant_exactly():
    """Without noise the Gram matrix is singular; the QR route then finds the poles to nine digits."""
    plant = structure()
    factors = compress_subspace_data([shaken(plant, 1500, 4, noise=0.0)], horizon=10)
    assert factors.factor.method == "qr"
    check(factors.model(6), 1e-8, 1e-6)


def test_two_records_with_states_of_their_own_count_as_one_experiment():
    """A structure that is already ringing when a log starts does not disturb the estimate."""
    plant = structure()
    ringing = 3 * np.ones(6)
    records = [shaken(plant, 2500, 5, x0=ringing), shaken(plant, 2500, 6, x0=-ringing)]
    start = compress_subspace_data(records, horizon=30).model(6)
    refined = refine(start, records)
    check(refined.model, 3e-4, 0.02)
    whiteness = [abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) for e in refined.residuals]
    assert max(whiteness) < 0.08  # an initial state ignored would ring on in the residual


def test_delay_is_respected_by_all_methods():
    """Inputs that act five samples late give the same structure when the delay is told."""
    plant = replace(structure(), delay=5)
    rng = np.random.default_rng(7)
    u = rng.normal(size=(5000, 2))
    late = np.vstack([np.zeros((5, 2)), u[:-5]])
    y = simulate_states(plant.A, late @ plant.B.T, np.zeros(6)) @ plant.C.T
    record = Record(u, y + 0.01 * y.std(axis=0) * rng.normal(size=y.shape), DT, ("a", "b"), ("c", "d"))
    start = compress_subspace_data([record], delay=5, horizon=30).model(6)
    assert start.delay == 5
    refined = refine(start, [record])
    check(refined.model, 3e-4, 0.02)
    told, untold = refined.loss, refine(replace(start, delay=0), [record], maximum_rounds=5).loss
    assert told < untold - 1
    assert np.abs(record.y[50:] - simulate(refined.model, record)[50:]).std() < 0.012 * record.y.std()
    f = np.array([7.4, 20.0])
    assert np.allclose(refined.model.frequency_response(f), plant.frequency_response(f), rtol=0.05)


def test_accelerations_keep_their_direct_term():
    """An accelerometer answers a force within the sample: the data choose a D, and it is the right one."""
    plant = structure(output="acceleration")
    record = shaken(plant, 6000, 8)
    model = refine(compress_subspace_data([record], horizon=30).model(6), [record]).model
    check(model, 1e-3, 0.05)
    assert np.allclose(model.D, plant.D, atol=0.02)


def test_signals_of_very_unlike_size_are_scaled_inside():
    """Newtons in and micrometres out, one output a million times the other: the same resonances."""
    record = shaken(structure(), 4000, 9)
    odd = replace(record, u=record.u * [1e4, 1e-3], y=record.y * [1e-6, 1.0])
    one = refine(compress_subspace_data([record], horizon=25).model(6), [record])
    other = refine(compress_subspace_data([odd], horizon=25).model(6), [odd])
    for a, b in zip(one.modes, other.modes, strict=True):
        assert a.frequency_hz == pytest.approx(b.frequency_hz, rel=1e-7)
        assert a.damping_stderr == pytest.approx(b.damping_stderr, rel=1e-3)


def compute_hankel_values(model):
    """Return the Hankel singular values (n,) of a stable model, largest first."""
    controllable, observable = (compute_root(gramian) for gramian in compute_gramians(model))
    return np.linalg.svd(observable.T @ controllable, compute_uv=False)


def test_arx_of_high_order_reduces_to_the_structure():
    """A long ARX model, balanced and cut to six states, has the structure's resonances."""
    record = shaken(structure(), 8000, 10)
    long = arx([record], 30)
    assert long.order == 60
    assert np.all(np.diff(compute_hankel_values(long)) <= 1e-12)
    check(reduce_order(long, 6), 2e-3, 0.1)


def test_arx_equals_least_squares_written_out():
    """The observer form predicts what the regression on lagged samples predicts."""
    record = shaken(structure(), 500, 11)
    model = arx([record], 3, direct=True)
    rows = [np.r_[[np.r_[record.u[t - k], record.y[t - k]] for k in (1, 2, 3)],].ravel() for t in range(3, 500)]
    X = np.hstack([np.array(rows), record.u[3:]])
    expected = X @ np.linalg.lstsq(X, record.y[3:], rcond=None)[0]
    assert np.allclose(predict(model, record)[10:], expected[7:], atol=1e-6 * record.y.std())


def test_reduction_keeps_the_response_within_twice_the_dropped_hankel_values():
    """Balanced truncation's error bound holds at every frequency."""
    record = shaken(structure(), 3000, 12, noise=0.1)
    long = arx([record], 8)
    small = reduce_order(long, 6)
    f = np.linspace(0.1, 99, 300)
    gap = np.linalg.norm(long.frequency_response(f) - small.frequency_response(f), axis=(1, 2), ord=2)
    assert gap.max() <= 2 * compute_hankel_values(long)[6:].sum() * (1 + 1e-9)


def test_pbsid_on_open_loop_data():
    """The predictor-based method agrees with the rest where there is no feedback."""
    check(pbsid([shaken(structure(), 20_000, 13)], 6, past=40), 2e-3, 0.15)


def test_era_returns_the_system_of_an_impulse_response():
    """Markov parameters without noise determine the poles and D exactly."""
    plant = structure(output="acceleration")
    model = era(plant.markov(600), DT, 6)
    check(model, 1e-9, 1e-7)
    assert np.allclose(model.D, plant.D)


def test_hammer_blows_give_frequency_damping_and_response():
    """Two blows of three samples, one on each input, 60 dB: decays give A and C, the whole records B."""
    plant = structure(seed=1)
    records = []
    rng = np.random.default_rng(14)
    for k in range(2):
        u = np.zeros((3000, 2))
        u[20:23, k] = 1.0, 2.0, 1.0
        quiet = Record(u, np.zeros((3000, 2)), DT, ("a", "b"), ("c", "d"))
        y = simulate(plant, quiet, np.zeros(6))
        records.append(replace(quiet, y=y + 1e-3 * y.std(axis=0) * rng.normal(size=y.shape)))
    model = decompose_pulse_tests(records).model(6, None)
    check(model, 1e-3, 0.05)
    f = np.array(FREQUENCIES)
    assert np.allclose(model.frequency_response(f), plant.frequency_response(f), rtol=0.05, atol=1e-5)


def test_lasting_excitation_is_no_pulse_test():
    """Without a rest after the pulse there is no decay, and that is said."""
    with raises_code("poor_excitation"):
        decompose_pulse_tests([shaken(structure(), 500, 15)])


def test_prediction_is_sharper_than_simulation_under_process_noise():
    """Unmeasured forces shake the structure too: one sample ahead is nearly known, far ahead is the simulation."""
    plant = structure()
    rng = np.random.default_rng(16)
    u, w = rng.normal(size=(6000, 2)), rng.normal(size=(6000, 2))
    y = simulate_states(plant.A, (u + 0.5 * w) @ plant.B.T, np.zeros(6)) @ plant.C.T
    record = Record(u, y, DT, ("a", "b"), ("c", "d"))
    model = refine(pbsid([record], 6, past=30), [record], kind="prediction_error").model
    errors = [(record.y - predict(model, record, k)).std() for k in (1, 10, 1000)]
    simulated = (record.y - simulate(model, record)).std()
    assert errors[0] < 0.1 * errors[1] < 0.1 * simulated
    assert errors[2] == pytest.approx(simulated, rel=0.02)
    check(model, 5e-3, 0.3)


def test_states_do_not_depend_on_the_poles_being_apart():
    """Five equal poles, real and not diagonalisable, are simulated as the recursion says, chunk after chunk."""
    A = 0.7 * np.eye(5) + np.diag(np.ones(4), 1)
    drive = np.random.default_rng(17).normal(size=(200, 5))
    x, expected = np.ones(5), []
    for row in drive:
        expected.append(x)
        x = A @ x + row
    assert np.allclose(simulate_states(A, drive, np.ones(5)), expected, rtol=1e-9, atol=1e-7)


def test_initial_state_is_found_again():
    """The state from which a noiseless response started is the one that fits best."""
    plant, x0 = structure(), np.arange(1.0, 7.0)
    record = shaken(plant, 400, 18, noise=0.0, x0=x0)
    assert np.allclose(estimate_initial_state(plant, record), x0, rtol=1e-6)


def test_daisy_robot_arm(measured):
    """The measured arm: order 4 simulates 96 % of its acceleration, stable; an ARX(8) of one half simulates the other."""
    data = np.loadtxt(measured("daisy_robot_arm/robot_arm.dat"))
    record = Record(data[:, :1], data[:, 1:], 1.0, ("torque",), ("acceleration",))

    def fit(model: StateSpace, part: Record) -> float:
        return 100 * (1 - np.linalg.norm(part.y - simulate(model, part)) / np.linalg.norm(part.y - part.y.mean()))

    for weighting in ("cva", "n4sid"):
        model = refine(compress_subspace_data([record], horizon=20).model(4, weighting), [record]).model
        assert fit(model, record) >= 96.5
        assert model.spectral_radius() < 1
    assert fit(arx([record.window(slice(0, 512))], 8), record.window(slice(512, None))) >= 94


def test_bad_input_is_refused_in_a_sentence():
    """Too short, not finite, unlike, or an order out of reach: said, not thrown as a traceback."""
    record = shaken(structure(), 300, 19)
    with raises_code("too_little_data"):
        compress_subspace_data([record], horizon=60)
    with raises_code("bad_sample"):
        arx([replace(record, y=np.full_like(record.y, np.nan))], 2)
    with raises_code("time_stamps"):
        Scales.of([record, replace(record, dt=0.1)])
    with raises_code("invalid_value", "40"):
        compress_subspace_data([record], horizon=5).model(40)
    with raises_code("invalid_value", "delay"):
        record.aligned(300)
    with raises_code("invalid_value", "weighting"):
        compress_subspace_data([record], horizon=5).model(2, "other")
    with raises_code("missing_input"):
        arx([], 2)
