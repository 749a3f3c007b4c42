"""One trial: a robot, logs of it, and what hides in them, all drawn from one number.

Training data are 110 s in one log or two, of which `diagnose` trains on 60 % (`share`), or 75 s with 45 s of held-out log
beside them. Amplitudes are scaled so that lambda is what was drawn (`strength.py`); where that takes more than the
form's cap, its inner parameters are drawn again, so what hides is never absurd.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hidden_effects_parts.actuator_forms import ACTUATOR_FORMS
from hidden_effects_parts.body_forms import BODY_FORMS
from hidden_effects_parts.drive_forms import DRIVE_FORMS
from hidden_effects_parts.forms import Form, Places, log_uniform
from hidden_effects_parts.friction_forms import FRICTION_FORMS, warm
from hidden_effects_parts.recording import Recording, Sensing, draw_motion, draw_sensing
from hidden_effects_parts.robots import DRAWS, Rig, draw_rig
from hidden_effects_parts.slip_forms import SLIP_FORMS
from hidden_effects_parts.strength import Ruler, base_columns
from hidden_effects_parts.timing_forms import TIMING_FORMS
from hidden_effects_parts.unknown_forms import UNKNOWN_FORMS
from tau_dyn.exceptions import InputError
from tau_dyn.identify import identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.simulate import Sensors, simulate

KNOWN_FORMS: tuple[type[Form], ...] = (
    *FRICTION_FORMS,
    *SLIP_FORMS,
    *DRIVE_FORMS,
    *BODY_FORMS,
    *TIMING_FORMS,
    *ACTUATOR_FORMS,
)
"""Every form that a cause of the contract explains."""

LAMBDA = (15.0, 600.0)
STRONG = (120.0, 600.0)
TRAINED = 0.6
"""Share of the data that is trained on where no log is held out."""

KNOWN_MODELS = 1 / 3
"""Share of `wide` clean sets in which the person has a model identified before."""

TRIES = 40


@dataclass(frozen=True, eq=False)
class Hidden:
    """One thing that hides in a set.

    Attributes:
        form: What it is.
        amplitude: How large [the form's unit].
        strength: lambda, any other hidden thing counted as known.
        strength_in_force: The same where encoders were perfect.
    """

    form: Form
    amplitude: float
    strength: float
    strength_in_force: float


@dataclass(frozen=True, eq=False)
class HiddenSet:
    """Logs, what a person knows, and the truth.

    Attributes:
        number: Number of the set.
        what: `clean`, `feedback`, `single`, `pairs` or `unknown`.
        rig: The robot.
        sensing: Its sensors.
        logs: Logs to train on, or to divide.
        held: Held-out logs; none where `logs` are divided.
        hidden: What hides.
        runs: The logs before noise; none for logs with feedback.
        held_runs: The held-out logs before noise.
        nominal: Whether bodies are as the robot file says within 2 %.
        known: A model identified from an earlier log, which the person has as a file; None where there is none.
    """

    number: int
    what: str
    rig: Rig
    sensing: Sensing
    logs: tuple[Log, ...]
    held: tuple[Log, ...]
    hidden: tuple[Hidden, ...]
    runs: tuple[Recording, ...]
    held_runs: tuple[Recording, ...]
    nominal: bool
    known: Model | None = None

    @property
    def model(self) -> Model:
        """The person's model."""
        return self.known or self.rig.model

    @property
    def bodies_known(self) -> bool:
        """Whether the person's model has the true bodies, so that no `parameter` finding is right: findings refer to it."""
        return self.nominal or self.known is not None


def draw_set(
    what: str,
    number: int,
    *,
    seed: int = 0,
    forms: Sequence[type[Form]] | None = None,
    seconds: float = 110.0,
    strength: tuple[float, float] | None = None,
    robots: str = "any",
) -> HiddenSet:
    """Draw a set.

    Args:
        what: `clean`, `feedback`, `single`, `pairs` or `unknown`.
        number: Number of the set; with `seed` it settles everything.
        seed: Of the study.
        forms: Forms to draw from; by default all known ones, or all unknown ones.
        seconds: Length of the training data, or of all data where no log is held out [s].
        strength: Range that lambda is drawn from.
        robots: Robots of clean sets, as `robots.DRAWS` calls them.
    """
    rng = np.random.default_rng([seed, number, sum(map(ord, what))])
    if what == "feedback":
        return _with_feedback(number, rng, seconds)
    if what == "clean":
        return _clean(number, rng, seconds, robots)
    pool = tuple(forms or (UNKNOWN_FORMS if what == "unknown" else KNOWN_FORMS))
    for _ in range(TRIES):
        found = _with_forms(what, number, rng, pool, seconds, strength or (STRONG if what == "pairs" else LAMBDA))
        if found is not None:
            return found
    raise RuntimeError(f"no {what} set {number} after {TRIES} tries")


def hidden_force(plain: Recording, run: Recording) -> np.ndarray:
    """Return what hides in a run's force (N, na): what rigid body and base friction do not give at the motion shown."""
    if run.q is plain.q:
        return run.tau - plain.tau
    return run.tau - run.rig.force(run.q, run.v, run.a)


def _clean(number: int, rng: np.random.Generator, seconds: float, robots: str) -> HiddenSet:
    """Nothing hides; half the robots have the masses their files say, and a third have thermometers."""
    nominal = bool(rng.random() < 0.5)
    base = str(rng.choice(("asymmetric", "asymmetric", "symmetric")))
    rig = draw_rig(DRAWS[robots](rng), base, rng, off=0.02 if nominal else 0.1)
    sensing = draw_sensing(rig, rng)
    runs, held = _runs(rig, sensing, rng, seconds, 1, ())
    if rng.random() < 1 / 3:
        tau, rise = float(rng.uniform(40, 120)), float(rng.uniform(8, 25))
        runs, held = ([warm(run, tau, rise) for run in x] for x in (runs, held))
    done = _finished("clean", number, rig, sensing, runs, held, (), rng, nominal)
    if robots != "wide" or rng.random() > KNOWN_MODELS:
        return done
    earlier = Recording.of(rig, draw_motion(rig, seconds / 2, rng, "fourier"), sensing.rate_hz, len(runs) + len(held))
    return replace(done, known=_identify(rig, earlier.log(sensing, rng, "earlier.csv")))


def _identify(rig: Rig, log: Log) -> Model:
    """Return the model that a person identified from an earlier log, written to a file and read back."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        identify(rig.nominal, log, model=rig.model).model.save(path)
        return Model.load(path)


def _with_forms(
    what: str,
    number: int,
    rng: np.random.Generator,
    pool: Sequence[type[Form]],
    seconds: float,
    strength: tuple[float, float],
) -> HiddenSet | None:
    """Return a set in which one form of the pool hides, or two; None where the draw would take an absurd amplitude."""
    kinds = _kinds(what, pool, rng)
    base = str(rng.choice(kinds[0].base))
    rig = draw_rig(
        "l1" if what == "pairs" else DRAWS[kinds[0].robots](rng), base, rng, off=0.1 if kinds[0].refit else 0.02
    )
    motions = sum((kind.motions for kind in kinds), ())
    sensing = draw_sensing(rig, rng)
    runs, held = _runs(rig, sensing, rng, seconds, max(kind.runs for kind in kinds), motions)
    share = 1.0 if held else TRAINED
    places = Places.of(runs)
    forms = [kind.draw(rig, places, rng) for kind in kinds]
    targets = [log_uniform(rng, *strength) for _ in forms]
    columns = [base_columns(run) for run in runs]
    hidden = _scaled_together(
        forms,
        targets,
        runs,
        lambda *others, encoder=True: Ruler.of(
            runs, columns, sensing, share, others[0] if others else (), encoder=encoder
        ),
    )
    if hidden is None:
        return None
    for item in hidden:
        runs, held = ([item.form.act(run, item.amplitude) for run in x] for x in (runs, held))
    return _finished(what, number, rig, sensing, runs, held, hidden, rng, not forms[0].refit)


def _kinds(what: str, pool: Sequence[type[Form]], rng: np.random.Generator) -> list[type[Form]]:
    if what != "pairs":
        return [pool[int(rng.integers(len(pool)))]]
    fit = [f for f in pool if f.refit and f.runs == 1 and f.robots != "arm" and "asymmetric" in f.base]
    while True:
        a, b = (fit[int(k)] for k in rng.choice(len(fit), 2, replace=False))
        if not set(a.names) & set(b.names):
            return [a, b]


def _scaled_together(
    forms: Sequence[Form], targets: Sequence[float], runs: Sequence[Recording], ruler: Callable[..., Ruler]
) -> tuple[Hidden, ...] | None:
    """Return the forms at amplitudes that make each as strong as wanted with the other one known.

    `ruler(*others, encoder=...)` measures with the other's forces known.
    """
    found: list[Hidden | None] = [None] * len(forms)
    for sweep in range(len(forms)):  # a pair once more: the other's shape may change with its amplitude
        for k, (form, target) in enumerate(zip(forms, targets, strict=True)):
            other = [x for m, x in enumerate(found) if m != k and x is not None]
            known = [[hidden_force(run, x.form.act(run, x.amplitude)) for run in runs] for x in other]
            measure = ruler(*known)
            amplitude = scaled(form, runs, measure, target) if form.refit else form.cap
            if amplitude is None:
                return None
            force = [hidden_force(run, form.act(run, amplitude)) for run in runs]
            last = sweep == len(forms) - 1
            in_force = ruler(*known, encoder=False).strength(force) if last else np.nan
            found[k] = Hidden(form, amplitude, measure.strength(force), in_force)
    return tuple(x for x in found if x is not None)


def scaled(form: Form, runs: Sequence[Recording], ruler: Ruler, target: float) -> float | None:
    """Return the amplitude at which a form is as strong as wanted, or None where that is beyond its cap."""
    amplitude = 0.2 * form.cap
    for _ in range(1 if form.linear else 6):
        now = ruler.strength([hidden_force(run, form.act(run, amplitude)) for run in runs])
        if not now > 0:
            return None
        step = float(np.sqrt(target / now))
        amplitude *= step
        if amplitude > form.cap:
            return None
        if abs(step - 1) < 0.01:
            break
    return amplitude


def _runs(
    rig: Rig, sensing: Sensing, rng: np.random.Generator, seconds: float, fewest: int, kinds: tuple[str, ...]
) -> tuple[list[Recording], list[Recording]]:
    """Return training and held-out runs in which nothing hides yet."""
    kind = (lambda: str(rng.choice(kinds))) if kinds else (lambda: None)
    split = fewest > 1 or rng.random() < 0.5
    if split:
        n = max(fewest, int(rng.integers(1, 3)))
        parts, later = [seconds / n] * n, []
    else:
        parts, later = [0.68 * seconds], [0.41 * seconds]
    rate = sensing.rate_hz
    made = [Recording.of(rig, draw_motion(rig, s, rng, kind()), rate, k) for k, s in enumerate([*parts, *later])]
    return made[: len(parts)], made[len(parts) :]


def _finished(
    what: str,
    number: int,
    rig: Rig,
    sensing: Sensing,
    runs: Sequence[Recording],
    held: Sequence[Recording],
    hidden: tuple[Hidden, ...],
    rng: np.random.Generator,
    nominal: bool,
) -> HiddenSet:
    logs = tuple(run.log(sensing, rng, f"log{run.number + 1}.csv") for run in runs)
    later = tuple(run.log(sensing, rng, f"held{run.number + 1}.csv") for run in held)
    return HiddenSet(number, what, rig, sensing, logs, later, hidden, tuple(runs), tuple(held), nominal)


def _with_feedback(number: int, rng: np.random.Generator, seconds: float) -> HiddenSet:
    """Return a clean set recorded while a controller drives the robot through its noisy encoders."""
    nominal = bool(rng.random() < 0.5)
    rig = draw_rig(DRAWS["cart"](rng), "asymmetric", rng, off=0.02 if nominal else 0.1)
    sensing = draw_sensing(rig, rng)
    sensors = Sensors(
        encoder_noise=sensing.encoder,
        encoder_resolution=sensing.resolution,
        force_noise=sensing.force,
        force_ar=(sensing.colour,) if sensing.colour else (),
        log_rate_hz=sensing.rate_hz,
        tool=False,
    )
    for _ in range(TRIES):
        motion = draw_motion(rig, seconds, rng)
        try:
            log = simulate(rig.driven, motion, sensors=sensors, seed=int(rng.integers(2**31)), name="log1.csv")
        except InputError:  # the motion asks for more force than the drives have
            continue
        return HiddenSet(number, "feedback", rig, sensing, (log,), (), (), (), (), nominal)
    raise RuntimeError(f"no feedback set {number} after {TRIES} tries")
