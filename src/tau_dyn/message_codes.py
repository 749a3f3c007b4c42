"""Codes of errors and warnings, each with cause and remedy: stable names for programs, while sentences may be reworded.

The code of an error follows its sentence in brackets. It is also in `TauDynError.code` and, if the data cannot answer, under
`code` in JSON. A `CodedWarning` is a `str` with a code, so every list of sentences may hold it: `warning_codes` in JSON is
parallel to `warnings`. `docs/reference/message_codes.md` is made from these tables.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Self

UNCODED = "note"
"""Code of a sentence that no program needs to identify."""


class CodedWarning(str):
    """A sentence with a code, such as `lost_samples`, and the affected joints if a program needs them."""

    code: str
    joints: tuple[str, ...]

    def __new__(cls, code: str, sentence: str, joints: Sequence[str] = ()) -> Self:
        """Keep code and joints with the sentence."""
        made = super().__new__(cls, sentence)
        made.code, made.joints = code, tuple(joints)
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep code and joints if a result is transferred between processes."""
        return CodedWarning, (self.code, str(self), self.joints)


class RepairedWarning(CodedWarning):
    """A fault whose samples were repaired or left out: a note about the log; no result is biased."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep code and class if a result is transferred between processes."""
        return RepairedWarning, (self.code, str(self), self.joints)


def get_code(sentence: str) -> str:
    """Return the code of a warning; `note` for a plain sentence."""
    return getattr(sentence, "code", UNCODED)


def format_with_code(sentence: str) -> str:
    """Return a warning followed by its code in brackets; return a plain sentence unchanged."""
    code = get_code(sentence)
    return str(sentence) if code == UNCODED else f"{sentence} [{code}]"


def format_warnings(warnings: Iterable[str]) -> dict[str, Any]:
    """Return the fields of a JSON result: sentences and their codes as parallel lists, and the joints by code, if any."""
    once = list(dict.fromkeys(warnings))
    joints: dict[str, list[str]] = {}
    for sentence in once:
        if isinstance(sentence, CodedWarning) and sentence.joints:
            named = joints.setdefault(sentence.code, [])
            named += [joint for joint in sentence.joints if joint not in named]
    return {
        "warnings": [str(sentence) for sentence in once],
        "warning_codes": [get_code(sentence) for sentence in once],
        **({"warning_joints": joints} if joints else {}),
    }


class MessageCode(NamedTuple):
    """Cause and remedy of a code."""

    cause: str
    remedy: str


INPUT_CODES: dict[str, MessageCode] = {
    "bad_option": MessageCode("an option is missing, malformed or excludes another", "`tau-dyn COMMAND --help`"),
    "bad_sample": MessageCode(
        "a value of a log or table is no finite number or cannot be true", "mend the row named, or leave it out"
    ),
    "cannot_read": MessageCode("a file exists and cannot be read", "check its permissions and that it is a file"),
    "cannot_write": MessageCode("an output cannot be written, or would replace an input", "name another file"),
    "damaged_file": MessageCode("a file is empty, cut off or damaged inside", "copy or record it again"),
    "download_failed": MessageCode(
        "a published file could not be downloaded", "connect to the network, or set `TAU_DYN_DATA`"
    ),
    "duplicate_name": MessageCode("a name occurs twice where it must be unique", "rename one"),
    "file_format": MessageCode(
        "a file is not of the kind expected, or an entry of it is not as the format has it",
        "[files](files.md) and [robot files](robots.md)",
    ),
    "file_not_found": MessageCode("a file or folder does not exist", "correct the path"),
    "file_too_large": MessageCode(
        "a file or table is larger than the limit for reading", "give an excerpt, or Parquet"
    ),
    "infeasible": MessageCode(
        "fixed and bounded values exclude every physical solution", "widen `--bound`, drop a `--fix`"
    ),
    "invalid_value": MessageCode("a value is outside the allowed range", "the range is in the sentence"),
    "loop_not_closed": MessageCode(
        "a kinematic loop does not close at a position", "correct position, units or geometry"
    ),
    "mismatch": MessageCode(
        "two inputs do not belong together: joints, sampling, units, motion or campaign", "give the matching file"
    ),
    "missing_column": MessageCode("a log or table lacks a column", "name it in a column map (`--columns`)"),
    "missing_input": MessageCode("no log, image or pose was given", "name one"),
    "missing_package": MessageCode("an optional package is not installed", "the `pip install` in the sentence"),
    "not_available": MessageCode("a compiler, port, scheduler or lock cannot be had", "start it, or name another"),
    "robot_structure": MessageCode(
        "a robot file's links, joints or loops do not make a robot", "correct the element named"
    ),
    "time_stamps": MessageCode(
        "time stamps do not increase, are uneven or have a gap", "correct the clock, or cut the log"
    ),
    "unknown_name": MessageCode("a name does not exist", "the sentence lists those that do"),
    "unreachable": MessageCode(
        "a position, path or motion is out of reach or beyond a limit", "change the target or limit"
    ),
    "unstable": MessageCode("a filter, loop or simulation is unstable", "lower its gains or cutoff"),
    "unsupported": MessageCode(
        "this robot, effect or model cannot do the requested task", "the sentence names those that can"
    ),
    "wrong_checksum": MessageCode(
        "a file is not the published one: its sha256 differs", "fetch it again, or replace the copy in `TAU_DYN_DATA`"
    ),
    "wrong_shape": MessageCode("an array has another shape than needed", "the shape is in the sentence"),
    "wrong_unit": MessageCode(
        "numbers are so large or small that their unit must be another", "SI units, or a column map"
    ),
}
"""Codes of faulty input; exit status 2."""

UNANSWERED_CODES: dict[str, MessageCode] = {
    "log_not_usable": MessageCode("`check` found a fault", "see `findings`"),
    "no_solution": MessageCode(
        "no motion, pose or model within the limits was found", "loosen a limit, or start nearer"
    ),
    "not_accurate_enough": MessageCode(
        "the planned measurement would miss the accuracy asked for", "more or other poses"
    ),
    "not_identifiable": MessageCode("the data do not determine the requested result", "the experiment in the sentence"),
    "not_visible": MessageCode("the camera or device does not see the target", "move the device or the target"),
    "nothing_to_do": MessageCode("no open question is left that a measurement would answer", "none needed"),
    "positions_missing": MessageCode("`columns`: no column is a position", "name one"),
    "poor_excitation": MessageCode("the motion or force hardly changes", "move every joint faster, both ways"),
    "too_little_data": MessageCode("too few samples, poses or images", "record longer, or more"),
}
"""Codes of sound data that cannot answer; exit status 3. `too_little_data` has status 2 if a file is not usable at all."""

DEFECT_CODES: dict[str, MessageCode] = {
    "workers_lost": MessageCode("processes of a study ended before their work", "run the item alone; more memory"),
}
"""Codes of failures that are not the input's; exit status 1."""

ERROR_CODES = INPUT_CODES | UNANSWERED_CODES | DEFECT_CODES
"""All codes of errors."""

WARNING_CODES: dict[str, MessageCode] = {
    "note": MessageCode("anything else", "read the sentence"),
    "positions_from_loop": MessageCode(
        "positions of drives follow over a loop from those of its other joints",
        "no action, if those encoders' signs and zeros are the robot file's",
    ),
    "redundant_drives": MessageCode(
        "more drives than freedoms: forces are generalised ones of all drives", "log every drive's force"
    ),
    "prediction_missed": MessageCode(
        "a trial of `learn` ended above its predicted interval", "the sentence names the change"
    ),
    "model_contradicted": MessageCode(
        "`learn`, `observe`: the log contradicts the model that was given", "identify the model again"
    ),
    "near_limit": MessageCode(
        "a gain is close to its stability limit, or a motion exceeds a limit between the places checked",
        "a lower gain; a margin, or more nodes",
    ),
    "not_corrected": MessageCode("positions cannot be compensated", "the reason is in their row"),
    "preload_low": MessageCode(
        "`feedforward share`: a preloaded drive changes its flank, so the gear passes its backlash",
        "the preload in the sentence, or a slower motion",
    ),
    "path_deviates": MessageCode("a RAPID program leaves its motion", "move slower, or send a reference"),
    "poses_reread": MessageCode(
        "a pose file follows another convention than documented: sign, zero, order, unit, orientation or rows",
        "correct the file, or a column map (`--columns`); the answer uses the reading that is named",
    ),
    "columns_read": MessageCode(
        "columns of a pose file have foreign names and are read by them", "our names, or a column map (`--columns`)"
    ),
    "implausible_effect": MessageCode(
        "a law with a sign or size that no machine has explains poses best",
        "check gravity and masses in the robot file",
    ),
    "home_searched": MessageCode(
        "the loops do not close from the robot file's zeros, and a home was searched for",
        "`<tau_dyn:home>` in the robot file where another assembly mode is meant",
    ),
    "quarter_turn": MessageCode(
        "five squares look the same after a quarter turn: one turn is a convention",
        "no action if the target's frame is unknown",
    ),
    "frame_undetermined": MessageCode(
        "training poses leave open where the device or the target is, so a move cannot be tested",
        "train on poses that turn every joint",
    ),
    "new_place": MessageCode(
        "held-out distances or touches are at a place that the training poses do not show",
        "no action needed; an error common to all rows of that place does not show",
    ),
    "size_undetermined": MessageCode(
        "only touches were measured, which do not show the size of the robot", "measure one distance as well"
    ),
    "orientation_unused": MessageCode(
        "orientations are constant, or missing in one file",
        "measure both in the same way; positions alone are compared",
    ),
    "contact": MessageCode("the tool rests on something", "keep such samples out of training; the fit leaves them out"),
    "changes_within_log": MessageCode(
        "a sign, gain, friction, tool or the base changes inside a log", "cut the log at the time stated"
    ),
    "droop": MessageCode("a proportional servo stays behind its command at rest", "no action; it is no backlash"),
    "gain_unknown": MessageCode(
        "no servo law: masses are known up to its gain", "`--controller LAW.yaml` or a weighed mass"
    ),
    "law_incomplete": MessageCode(
        "fits at each servo gain alone disagree", "add the entry that is named to the controller file"
    ),
    "not_settled": MessageCode(
        "simulated joints of a servo robot push each other without end", "check gains, delays and inertias in the files"
    ),
    "outside_training": MessageCode("held-out logs accelerate more than the training's", "train on faster motions"),
    "track_undersampled": MessageCode(
        "`observe --camera`: images differ from their neighbours by more than their corners explain",
        "more images a second, or a slower motion",
    ),
    "unsigned_load": MessageCode("a load channel has no sign", "do not map it to torque"),
    "column_missing": MessageCode("`columns`: no clock or torque", "add it to the map"),
    "column_unsure": MessageCode("`columns`: perhaps another signal or joint", "check the map"),
    "torque_constant_missing": MessageCode("`columns`: a current is no torque", "scale it"),
    "unit_unsure": MessageCode("`columns`: a unit was guessed", "check the scale"),
    "feedback_found": MessageCode(
        "`modes`: an input follows the part of the outputs that a causal model does not explain",
        "log the reference, `--reference`",
    ),
    "force_late": MessageCode(
        "the force is late or early by more than 0.7 samples", "shift `tau` by the stated time; one clock for all"
    ),
    "force_is_voltage": MessageCode(
        "forces are a constant times `voltage_J` or `pwm_J`",
        "log the current as well; `back_emf` in [causes](causes.md)",
    ),
    "force_at_limit": MessageCode(
        "forces are too often at the drives' limits", "a gentler motion; other limits in the file"
    ),
    "drives_held": MessageCode(
        "no drive has a stated stiffness: stiffness and resonances are upper bounds",
        "`<tau_dyn:drive_spring>` or `--actuator-stiffness`",
    ),
    "springs_not_identified": MessageCode(
        "no vibration record determines the stiffness of these springs",
        "blows in other directions and at other places, at poses where these springs yield",
    ),
    "force_lowpassed": MessageCode(
        "a first-order lag explains the force better than a delay", "log the force before the filter"
    ),
    "contact_unknown": MessageCode(
        "a log of a walking robot does not show when a foot touches the ground", "log `contact_FRAME`, 0 or 1"
    ),
    "base_velocity_frame": MessageCode(
        "the base's velocity is in axes of the world", "turn it into axes of the base, or leave it out"
    ),
    "gravity_direction": MessageCode("gravity acts from another side", "turn the base in the robot file"),
    "gravity_subtracted": MessageCode(
        "forces lack gravity: the controller subtracted it, or the bodies are balanced unlike the file's",
        "log the motor torque; add the file's gravity back",
    ),
    "held_channel": MessageCode(
        "a channel is constant while its joint moves, or is updated less often than logged",
        "log all channels at one rate; frozen positions are left out",
    ),
    "faulty_channel": MessageCode("a channel dies, clips or slips", "mend it; dead stretches are left out"),
    "holdout_differs": MessageCode(
        "the held-out error of a joint is over 3 times the training error", "check machine, tool and load of both logs"
    ),
    "joints_exchanged": MessageCode("columns of two joints are exchanged", "the column map's lines in the sentence"),
    "load_changed": MessageCode(
        "a log carries a body at the tool that the others or the model file do not",
        "give it to `payload`, or leave it out",
    ),
    "clock_converted": MessageCode("dates, times of day or days became seconds", "check the rate"),
    "clocks_joined": MessageCode("signals of several clocks were put on one", "log all signals by one clock"),
    "column_without_numbers": MessageCode("a column is empty or nan throughout", "log it, or map another column"),
    "log_layout": MessageCode("how an unusual text file was read", "check that it was meant so"),
    "samples_left_out": MessageCode("rows without a number were left out", "let the logger fill every cell"),
    "lost_samples": MessageCode(
        "samples are missing under an even clock",
        "log time stamps; the clock is corrected up to 1 %, else record again",
    ),
    "mean_removed": MessageCode("the mean of a force was removed", "log the force without this processing"),
    "model_subtracted": MessageCode(
        "forces lack all that the bodies need: the controller subtracted its model",
        "log the motor torque; add the file's nominal force back",
    ),
    "not_physical": MessageCode(
        "plain least squares is over 3 standard errors outside the physical range", "`diagnose`; a richer motion"
    ),
    "no_coherence": MessageCode(
        "`modes`: the outputs do not follow the inputs near a mode", "more force there, or less noise"
    ),
    "tone_of_input": MessageCode("`modes`: a mode is a tone of the inputs", "noise or a sweep as input"),
    "time_limit": MessageCode(
        "`modes --time-limit`: the time was over before all was tried",
        "a larger limit; `--order`, `--delay` or `--method` where they are known",
    ),
    "order_at_limit": MessageCode("`modes`: the highest order tried was taken", "`--order N`; a longer log"),
    "copied_data": MessageCode(
        "two logs hold the same samples: given twice, an excerpt, another clock or rate, rounded or with added noise",
        "give each recording once; hold out a recording of its own",
    ),
    "poor_fit": MessageCode(
        "over a fifth of a joint's force is neither fitted nor noise, or a simulated loop is off by 1.5 times the encoder's",
        "`check` and `diagnose`; sign, unit and order of columns",
    ),
    "repeated_samples": MessageCode("samples are repeated or stale", "log each sample once; they are left out"),
    "response_nonlinear": MessageCode(
        "`modes`: powers of the response explain over a tenth of the residual", "test at several levels of force"
    ),
    "rests_mostly": MessageCode("joints rest more than half of the time", "read `all_samples`; move them more"),
    "scale_wrong": MessageCode(
        "positions, forces or the clock have another scale", "the column map's line in the sentence"
    ),
    "setups_differ": MessageCode(
        "a resonance has different frequencies in the set-ups of one test",
        "move the sensor without changing mass, temperature or posture; keep sensors of equal mass at all places",
    ),
    "short_log": MessageCode(
        "segments left out, or few independent values", "record without gaps, half a minute or more"
    ),
    "sign_reversed": MessageCode(
        "q, tau or both have the wrong sign, or friction is negative", "`scale: -1` in the column map"
    ),
    "stiffness_unknown": MessageCode(
        "the stiffness of a rod or drive is not stated, so that of the tool is unknown",
        "springs in the robot file, `--rod-stiffness`, `--actuator-stiffness`",
    ),
    "stamps_chosen": MessageCode("a bag's messages carry stamps, and these are the clock", "nothing"),
    "stamps_scatter": MessageCode(
        "time stamps scatter around the even clock of the device",
        "log time stamps of the measurement; the clock is corrected",
    ),
    "stderr_rounded": MessageCode("standard errors were zero", "write them with more digits"),
    "updated_less_often": MessageCode(
        "channels are held or interpolated from a lower rate", "log at that rate; only the updates are used"
    ),
    "zero_force_runs": MessageCode(
        "a force is zero between large forces", "flag the samples (`--exclude`); short ones are interpolated"
    ),
}
"""Codes of warnings."""
