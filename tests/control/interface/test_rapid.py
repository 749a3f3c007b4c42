"""RAPID programs: they parse by a small grammar, and what they drive to is the motion, in mm and degrees."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tau_dyn.control import build_waypoints, format_rapid_motion
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import convert_to_quaternions, forward_kinematics
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory

TOKEN = re.compile(
    r'\s*(?:!(?P<comment>[^\n]*)|(?P<string>"[^"\n]*")|(?P<number>-?\d+(?:\.\d+)?(?:E[+-]?\d+)?)'
    r"|(?P<word>[A-Za-z]\w{0,31})|(?P<sign>:=|<=|[-\\\[\](){},;:+<>=]))"
)


class Rapid:
    """A parser of the part of RAPID that is written: declarations of constants, procedures, moves, loops, calls."""

    def __init__(self, text: str) -> None:
        """Split into tokens and read the module."""
        self.tokens, self.constants, self.moves, at = [], {}, [], 0
        while text[at:].strip():
            found = TOKEN.match(text, at)
            assert found, f"no token of RAPID: {text[at : at + 30]!r}"
            at = found.end()
            if found.lastgroup and found.lastgroup != "comment":
                self.tokens.append((found.lastgroup, found[found.lastgroup]))
        self.at = 0
        self.expect("MODULE")
        self.name = self.word()
        while self.peek() in ("CONST", "PERS", "VAR"):
            self.declaration()
        while self.peek() == "PROC":
            self.procedure()
        self.expect("ENDMODULE")
        assert self.at == len(self.tokens)

    def peek(self) -> str:
        """Return the next token's text."""
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

    def take(self) -> tuple[str, str]:
        """Return the next token."""
        self.at += 1
        return self.tokens[self.at - 1]

    def expect(self, *texts: str) -> None:
        """Take these tokens and no others."""
        for text in texts:
            assert self.take()[1] == text, f"expected {text} near {self.tokens[self.at - 3 : self.at + 3]}"

    def word(self) -> str:
        """Take a name."""
        kind, text = self.take()
        assert kind == "word", text
        return text

    def declaration(self) -> None:
        """Read `CONST type name{n} := value;`."""
        self.take()
        self.word()
        name, size = self.word(), None
        if self.peek() == "{":
            self.expect("{")
            size = int(self.take()[1])
            self.expect("}")
        self.expect(":=")
        value = self.value()
        self.expect(";")
        assert size is None or (isinstance(value, list) and len(value) == size), f"{name} has not {size} entries"
        self.constants[name] = value

    def value(self):
        """Read a number, a string or an aggregate."""
        if self.peek() != "[":
            kind, text = self.take()
            return float(text) if kind == "number" else text
        self.expect("[")
        out = [self.value()]
        while self.peek() == ",":
            self.expect(",")
            out.append(self.value())
        self.expect("]")
        return out

    def procedure(self) -> None:
        """Read `PROC name(...) ... ENDPROC`."""
        self.expect("PROC")
        self.word()
        self.expect("(")
        while self.peek() != ")":
            self.take()
        self.expect(")")
        self.block("ENDPROC")

    def block(self, end: str) -> None:
        """Read statements up to an end."""
        while self.peek() != end:
            self.statement()
        self.expect(end)

    def statement(self) -> None:
        """Read a loop or an instruction."""
        if self.peek() == "FOR":
            self.expect("FOR")
            self.word()
            self.expect("FROM")
            self.expression()
            self.expect("TO")
            self.expression()
            self.expect("DO")
            return self.block("ENDFOR")
        name, arguments = self.word(), []
        if self.peek() == "\\":
            self.option()
        while self.peek() != ";":
            arguments.append(self.expression())
            while self.peek() == "\\":
                arguments.append(self.option())
            if self.peek() == ",":
                self.expect(",")
        self.expect(";")
        if name.startswith("Move"):
            self.moves.append((name, arguments))
        return None

    def option(self) -> str:
        r"""Read `\Name` or `\Name:=value`."""
        self.expect("\\")
        name = self.word()
        if self.peek() == ":=":
            self.expect(":=")
            self.expression()
        return "\\" + name

    def expression(self) -> str:
        """Read a name with an index, a number, and differences of them."""
        kind, text = self.take()
        assert kind in ("word", "number"), text
        if self.peek() == "{":
            self.expect("{")
            text += "{" + self.expression() + "}"
            self.expect("}")
        while self.peek() in ("-", "+") or (kind == "word" and self.peek().startswith("-")):
            text += self.take()[1]
            if text[-1] in "+-":
                text += self.take()[1]
        return text


def motion_of(robot) -> Trajectory:
    """Return a swing of all drives and back, with a pause."""
    t = np.arange(1000) * 0.004
    s = np.sin(np.pi * np.clip(t / 3.6, 0, 1)) ** 2
    size = np.where(np.array(robot.joint_kinds) == "prismatic", 0.03, 0.1) * (1 + 0.1 * np.arange(robot.na))
    return Trajectory.through(robot.actuated, t, robot.home + s[:, None] * size)


@pytest.mark.parametrize("name", ["gantry_tau", "gantry_tau_f1"])
def test_joint_moves_follow_the_motion(name) -> None:
    """Straight lines between the places, each in its time, leave the motion by less than the tolerance; mm and deg."""
    robot = load_robot(name)
    motion = motion_of(robot)
    program = Rapid(format_rapid_motion(robot, motion, tolerance=4e-4))  # moves of 0.1 s leave F1's swing by 3e-4 rad
    unit = np.where(np.array(robot.joint_kinds) == "prismatic", 1e3, np.rad2deg(1.0))
    places = np.array([row[0][: robot.na] for row in program.constants["places"]]) / unit
    assert all(
        row[0][robot.na :] == [0.0] * (6 - robot.na) and row[1] == [9e9] * 6 for row in program.constants["places"]
    )
    t = np.cumsum(program.constants["seconds"])
    assert 5 < len(places) < 120 and program.constants["n_places"] == len(places)
    follows = np.column_stack([np.interp(motion.t, t, x) for x in places.T])
    assert np.abs(follows - motion.q).max() < 4.1e-4
    assert [m[0] for m in program.moves] == ["MoveAbsJ"] * 3
    first, way, last = (m[1] for m in program.moves)
    assert first == ["places{1}", "\\NoEOffs", "v100", "fine", "tool0"]
    assert way == ["places{k}", "\\NoEOffs", "v1000", "\\T", "zones{k}", "tool0"] and last[4] == "fine"
    way = 1e3 * np.linalg.norm(np.diff(forward_kinematics(robot, places).poses.position, axis=0), axis=1)
    for k, (fine, radius, *_) in enumerate(program.constants["zones"][1:-1]):
        assert fine == "FALSE" and radius == pytest.approx(max(0.3, min(way[k], way[k + 1]) / 2), abs=0.01)
    assert way.max() > 2


@pytest.mark.parametrize("by", ["joints", "tool"])
def test_no_move_is_too_short_for_a_planner(by) -> None:
    """However small the tolerance, moves last 0.1 s or more; what that costs is said in the module."""
    robot = load_robot("gantry_tau")
    motion = motion_of(robot)
    text = format_rapid_motion(robot, motion, by=by, tolerance=1e-9)
    seconds = Rapid(text).constants["seconds"]
    assert min(seconds[1:]) >= 0.1 and sum(seconds) == pytest.approx(motion.duration)
    found = build_waypoints(robot, motion, by=by, tolerance=1e-9)
    assert found.deviation > 1e-6 and f"by up to {found.deviation:.2g} m or rad" in text


def test_tool_moves_follow_the_tool() -> None:
    """By MoveL the tool's places are the forward kinematics', mm, quaternions with the scalar first, in the work object."""
    robot = load_robot("gantry_tau_f1")
    motion = motion_of(robot)
    program = Rapid(format_rapid_motion(robot, motion, by="tool", tolerance=2e-4, tool="gripper", wobj="bench"))
    targets, t = program.constants["places"], np.cumsum(program.constants["seconds"])
    poses = forward_kinematics(robot, motion.q).poses
    place = np.array([row[0] for row in targets]) / 1e3
    follows = np.column_stack([np.interp(motion.t, t, x) for x in place.T])
    assert np.abs(follows - poses.position).max() < 2.1e-4
    index = np.searchsorted(motion.t, t - 1e-3)
    np.testing.assert_allclose(
        [row[1] for row in targets], np.roll(convert_to_quaternions(poses)[index], 1, axis=1), atol=1e-7
    )
    assert [m[0] for m in program.moves] == ["MoveJ", "MoveL", "MoveL"]
    assert all(m[1][-2:] == ["gripper", "\\WObj"] for m in program.moves)


def test_hostile_names_stay_in_comments() -> None:
    """A motion's name with a line break adds no instruction."""
    robot = load_robot("gantry_tau")
    motion = motion_of(robot)
    named = Trajectory(motion.joints, motion.t, motion.q, motion.v, motion.a, "x\nENDMODULE\nMODULE evil")
    assert Rapid(format_rapid_motion(robot, named)).name == "TauDynMotion"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"name": "1st"}, "'1st' is no name for a RAPID module"),
        ({"name": "EndProc"}, "no word of RAPID"),
        ({"tool": "a b"}, "no name for RAPID tool data"),
        ({"by": "feet"}, "by 'joints' or by 'tool', not by 'feet'"),
        ({"tolerance": 0.0}, "tolerance of a RAPID motion must be above zero"),
    ],
)
def test_bad_requests_are_refused(options, said) -> None:
    """A sentence, and no program."""
    robot = load_robot("gantry_tau")
    with pytest.raises(InputError, match=said):
        format_rapid_motion(robot, motion_of(robot), **options)
