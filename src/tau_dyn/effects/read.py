"""Effects as model files and effect files list them: `{effect: NAME, joints: [...], settings: {...}, label: ""}`."""

from __future__ import annotations

from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import Robot


def read_effects(rows: object, robot: Robot, where: str) -> tuple[Effect, ...]:
    """Build effects from a file's list.

    Joints default to all actuated ones, settings to the effect's own defaults.

    Raises:
        InputError: `where`, the file, has an entry that is no effect, or one that this robot cannot have.
    """
    if not isinstance(rows, list):
        raise InputError("file_format", f"{where}: 'effects' must be a list")
    units = dict(zip(robot.actuated, robot.force_units, strict=True))
    found = []
    for row in rows:
        if not isinstance(row, dict):
            raise InputError(
                "file_format",
                f"{where}: an entry of 'effects' is written {{effect: NAME}}, with joints and settings, not {repr(row)[:60]}",
            )
        if str(row.get("effect")) not in EFFECTS:
            raise UnknownName("effect", str(row.get("effect")), EFFECTS, where)
        joints = row.get("joints", list(robot.actuated))
        if not isinstance(joints, list):
            raise InputError(
                "file_format", f"{where}: 'joints' of effect {row['effect']} must be a list of names, not {joints!r}"
            )
        if not joints and issubclass(EFFECTS[row["effect"]], JointwiseEffect):
            raise InputError(
                "file_format",
                f"{where}: 'joints' of effect {row['effect']} is empty; name one, or leave it out for all of them",
            )
        joints = [str(joint) for joint in joints]
        for joint in joints:
            if joint not in units:
                raise UnknownName("actuated joint", joint, units, where)
        settings = row.get("settings") or {}
        if not isinstance(settings, dict):
            raise InputError(
                "file_format", f"{where}: 'settings' of effect {row['effect']} must be a mapping from names to numbers"
            )
        label = str(row.get("label") or "")
        settings = {str(key): value for key, value in settings.items()}
        beside = next((key for key in ("label", "joints", "units", "self") if key in settings), None)
        if beside is not None:
            raise InputError(
                "file_format",
                f"{where}: '{beside}' is no setting of effect {row['effect']}; it stands beside its settings",
            )
        try:
            found.append(EFFECTS[row["effect"]](joints, [units[j] for j in joints], label=label, **settings))
        except InputError as fault:
            raise InputError(fault.code, f"{where}: {fault}") from fault
    return tuple(found)
