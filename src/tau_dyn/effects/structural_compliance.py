r"""A compliant drive or structure that oscillates: the load deflects from the encoder and resonates at its own frequencies.

    encoder - load = sum over modes of C_i d_i,     d_i'' + 2 z_i w_i d_i' + w_i^2 d_i = w_i^2 F,     w_i = 2 pi f_i

with F (na,) the force of the rigid bodies, which springs carry. A mode far above the motion's band is the quasi-static
`joint_compliance`; a mode far below it acts as an additional mass. For a compliant drive, C has one number per joint. In a
compliant structure (`coupled`), a mode moves the loads of all joints together: its C is a matrix, symmetric by Maxwell's
reciprocity if forces and loads are at the same points (`reciprocal`), full if the measured tool is at another point than the
masses. Modes above the band respond at once: `rest` adds a matrix of compliance without oscillation. Frequencies and damping
are settings; `modes` is the number of the three modes that are used. References: Spong 1987; Dressler 2012, 6.3; Ewins 2000,
2.4 (modal sums) and 4.2 (residual terms of modes outside the band).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from tau_dyn.effects.effect import PlausibleRange, build_slide_and_hinge_ranges, format_amount, spell_unit
from tau_dyn.effects.jointwise import JointwiseDisplacement
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters

_ENDS = ("", "_2", "_3")
"""Suffixes of the names of each mode's settings and parameters."""
MAX_MODES = len(_ENDS)
_MIN_FREQUENCY_HZ = 3.0  # Hz; a slower structure moves with the robot like a body
_REACH = 2.5
"""Frequency of the stiffest spring tried, as a multiple of the observable ones: above it, it cannot be distinguished from a
quasi-static one."""
_STEP = 1.15  # ratio of neighbouring frequencies tried; the peaks of a damping of 0.1 overlap at it
_DAMPING = (0.03, 0.1)
_FREQUENCY_FACTORS = (0.97, 1.0, 1.03)
"""Settings around a proposed frequency; a refinement continues from the best of them."""


class StructuralCompliance(JointwiseDisplacement):
    """Springs between encoders and loads that resonate."""

    name = "structural_compliance"
    cause = True
    equation = (
        "encoder - load = compliance d, d'' + 2 damping w d' + w^2 d = w^2 F, w = 2 pi frequency; a sum over modes"
    )
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "a multisine around the suspected resonance, riding on a stroke of constant speed"
    mistaken_for = ("joint_compliance", "delay", "payload", "drive_gain")
    # Machine tools have 1e-8 m/N, light gantries 1e-5, flexible arms 1e-2 rad/(N m) (Dressler 2012, 6.3; Spong 1987). Modes of
    # frames and arms are damped by 0.5 to 5 %, with reducers up to 15 % (Ewins 2000, 3.8); beyond it modes do not resonate
    plausible = (
        *build_slide_and_hinge_ranges("structural_compliance", "Q/F", (-1e-4, -1e-2), (1e-4, 1e-2)),
        PlausibleRange("damping", 0.0, 0.15, setting=True),
    )
    needs = (*JointwiseDisplacement.needs, "rigid_force")
    nonnegative = True
    quantities = (("structural_compliance", "Q/F"),)
    defaults = {
        "frequency": 10.0, "damping": 0.03, "modes": 1, "frequency_2": 20.0, "damping_2": 0.03, "frequency_3": 40.0,
        "damping_3": 0.03, "coupled": 0, "reciprocal": 1, "rest": 0,
    }  # fmt: skip
    setting_units = {f"frequency{end}": "Hz" for end in _ENDS}
    positive = tuple(f"{key}{end}" for end in _ENDS for key in ("frequency", "damping"))
    whole = ("modes",)
    refined = ("frequency", "damping")
    open_ends = {"frequency": "both"}

    def __init__(self, joints: Sequence[str], units: Sequence[str], *, label: str = "", **settings: float) -> None:
        """Let the effect act; see `Effect`.

        Raises:
            InputError: A setting is not one that the effect can have.
        """
        super().__init__(joints, units, label=label, **settings)
        if self.settings["modes"] > MAX_MODES:
            raise InputError(
                "invalid_value",
                f"setting modes of effect {self.name} is {MAX_MODES} at most, not {self.settings['modes']:g}",
            )
        self.refined = tuple(f"{key}{end}" for end in self._ends for key in ("frequency", "damping"))

    @property
    def _ends(self) -> tuple[str, ...]:
        """Name suffixes of the modes in use."""
        return _ENDS[: int(self.settings["modes"])]

    @property
    def _coupled(self) -> bool:
        return bool(self.settings["coupled"]) and len(self.joints) > 1

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """One compliance per mode."""
        return tuple((f"structural_compliance{end}", "Q/F") for end in self._ends)

    @property
    def parameters(self) -> Parameters:
        """Its compliances: joint by joint, or the entries of each mode's matrix."""
        if not self._coupled:
            return super().parameters
        return Parameters([self._entry(end, i, j) for end, (i, j) in product(self._matrices, self._places)])

    @property
    def _matrices(self) -> tuple[str, ...]:
        """The same for each matrix of a structure: modes, and the residual compliance of modes above the band."""
        return (*self._ends, "_rest") if self.settings["rest"] else self._ends

    @property
    def _places(self) -> list[tuple[int, int]]:
        """Rows and columns of a mode's matrix that are parameters."""
        n = len(self.joints)
        return [(i, j) for i in range(n) for j in range(n) if i <= j or not self.settings["reciprocal"]]

    def _entry(self, end: str, i: int, j: int) -> Parameter:
        """Return an entry: the deflection of joint i's load by the force of joint j; entries of a matrix have no bounds."""
        one, other = self.joints[i], self.joints[j]
        owner = one if i == j else f"{one}+{other}"
        unit = spell_unit(f"{spell_unit('Q', self.units[one])}/F", self.units[other])
        return Parameter(f"{owner}.structural_compliance{end}{self.label}", 0.0, unit, origin=self.name)

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p); a structure's friction is in its guideways, in front of the compliance."""
        if not self._coupled:
            return super().columns(motion)
        return super().columns(motion.with_signals(damping=np.zeros_like(motion.v)))

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad]."""
        if not self._coupled:
            return super().displacement(motion)
        index, made = self._indices(motion), []
        answers = [compute_swinging_response(_felt(motion, f)[:, index], motion.t, f, z) for f, z in self._modes()]
        answers += [motion.signal("rigid_force")[:, index]] if self.settings["rest"] else []
        for d in answers:
            for i, j in self._places:
                column = np.zeros_like(motion.v, shape=motion.v.shape[::-1])
                column[index[i]] = d[:, j]
                if self.settings["reciprocal"]:
                    column[index[j]] = d[:, i]
                made.append(column)
        return np.stack(made, axis=1).transpose(2, 0, 1)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the dynamic response of each mode to the force; at rest, the force itself."""
        return [compute_swinging_response(_felt(joint, f)[:, None], joint.t, f, z)[:, 0] for f, z in self._modes()]

    def _modes(self) -> list[tuple[float, float]]:
        """Return frequency [Hz] and damping ratio of each mode."""
        return [(self.settings[f"frequency{end}"], self.settings[f"damping{end}"]) for end in self._ends]

    def describe(self, parameters: Parameters) -> str:
        """Return resonances and compliances, in words."""
        if not self._coupled:
            return super().describe(parameters)
        n, said = len(self.joints), []
        values = parameters.select(self.parameters.names).values.reshape(len(self._matrices), -1)
        for end, entries in zip(self._ends, values, strict=False):
            own = {(i, j): x for (i, j), x in zip(self._places, entries, strict=True)}
            top = max(range(n), key=lambda i: abs(own[i, i]))
            p = parameters[self._entry(end, top, top).name]
            said.append(f"{self._resonance(end, self.joints[top])}; {p.name.split('.')[0]} by {format_amount(p)}")
        return f"the structure yields and rings, all of it together: {'; '.join(said)}"

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return frequency, damping and compliance of each mode."""
        said = [
            f"{self._resonance(end, joint)}, of a part that yields by {format_amount(values[f'structural_compliance{end}'])}"
            for end in self._ends
        ]
        return " and ".join(said)

    def _resonance(self, end: str, joint: str) -> str:
        return f"a resonance at {self.setting(f'frequency{end}', joint)}, damping {100 * self.settings[f'damping{end}']:.2g} %"

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return each joint alone, or the structure as a whole if modes are proposed that no single joint explains."""
        return [tuple(scene.joints)] if scene.structure and len(scene.joints) > 1 else super().groups(scene)

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the frequencies to try.

        For one joint, frequencies in steps that a refinement bridges, with low and with high damping; no frequency for static
        poses. For the structure, and for several modes, those that the scene's resonances propose: the first, the first two,
        all.
        """
        highest = _REACH * scene.cutoff_hz
        if not np.isfinite(highest):
            return []
        proposed = scene.resonances[:MAX_MODES]
        if len(joints) > 1:
            whole = _whole(scene)
            alone = [_around([one], whole) for one in proposed]
            return [*(s for row in alone for s in row), *_several(proposed, whole)]
        steps = int(np.ceil(np.log(max(highest / _MIN_FREQUENCY_HZ, 1.0)) / np.log(_STEP)))
        found = np.geomspace(_MIN_FREQUENCY_HZ, highest, steps) if steps > 1 else []
        return [*({"frequency": float(f), "damping": d} for d in _DAMPING for f in found), *_several(proposed, {})]

    @classmethod
    def of_resonances(cls, scene: Scene, joints: tuple[str, ...]) -> StructuralCompliance:
        """Return the effect with all proposed modes on these joints; there must be at least one mode."""
        plain = cls(joints, [scene.units[scene.index(joint)] for joint in joints])
        return plain.with_settings(**cls.proposal(scene, joints))

    @classmethod
    def proposal(cls, scene: Scene, joints: tuple[str, ...]) -> dict[str, float]:
        """Return the settings of all proposed modes, unchanged; there must be at least one mode."""
        return _around(scene.resonances[:MAX_MODES], _whole(scene) if len(joints) > 1 else {})[1]


def _whole(scene: Scene) -> dict[str, float]:
    """Return the settings of a structure's modes: with full matrices if a tool is measured, at another point than the masses."""
    return {"coupled": 1, "rest": 1, "reciprocal": 0 if "tool" in scene.signals else 1}


def compute_swinging_response(F: np.ndarray, t: np.ndarray | None, frequency: float, damping: float) -> np.ndarray:
    """Return the response (N, n) of unit springs and masses to forces (N, n) that are linear between samples.

    Args:
        F: Forces [N or N m].
        t: Even clock (N,) [s]; None at rest, where the response is the force itself.
        frequency: Undamped natural frequency [Hz].
        damping: Damping ratio.
    """
    if t is None or len(t) < 2:
        return F
    from scipy import signal

    dt = float(t[-1] - t[0]) / (len(t) - 1)
    w = 2 * np.pi * frequency
    sampled: Any = signal.cont2discrete(([w**2], [1.0, 2 * damping * w, w**2]), dt, method="foh")
    b, a = np.ravel(sampled[0]), np.ravel(sampled[1])
    response, _ = signal.lfilter(b, a, F, axis=0, zi=np.outer(signal.lfilter_zi(b, a), F[0]))
    return np.asarray(response)


def _felt(motion: Motion | JointMotion, frequency: float) -> np.ndarray:
    """Return the force to which a mode responds.

    Quasi-statically the load's acceleration is a fourth derivative of the encoder's reading, of which only the part above the
    noise is of use. A mode within that band attenuates signals above its own frequency; for it, a low-pass of the force would
    distort its resonance.
    """
    clear = motion.signals.get("clear_hz")
    if clear is not None and frequency < clear[0]:
        return motion.signal("wide_force")
    return motion.signal("rigid_force")


def _around(modes: Sequence[tuple[float, float]], more: Mapping[str, float]) -> list[dict[str, float]]:
    """Return settings of several modes, all a little lower, as proposed, and a little higher."""
    found = []
    for share in _FREQUENCY_FACTORS:
        row: dict[str, float] = {"modes": len(modes), **more}
        for end, (f, z) in zip(_ENDS, modes, strict=False):
            row |= {f"frequency{end}": share * f, f"damping{end}": z}
        found.append(row)
    return found


def _several(proposed: Sequence[tuple[float, float]], more: Mapping[str, float]) -> list[dict[str, float]]:
    """Return settings of the two and the three strongest modes."""
    return [row for n in range(2, len(proposed) + 1) for row in _around(proposed[:n], more)]
