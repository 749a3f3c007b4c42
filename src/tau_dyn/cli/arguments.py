"""Arguments that several commands take: kinds of numbers and files, the robot, fitting a model to logs, outputs.

A command is a function; its signature is its command line. This module holds annotations of single parameters and frozen
dataclasses of options that belong together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token

from tau_dyn.cli.run_folder import RunFolder, read_destination
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes

if TYPE_CHECKING:
    import numpy as np

    from tau_dyn.log import Log, Recording
    from tau_dyn.model import Model
    from tau_dyn.robot import Robot

STDOUT = Path("-")
"""File name for stdout."""
SEVERAL = (1, None)
"""An option that takes one or more values, and may be repeated."""


@dataclass(frozen=True)
class Kind:
    """A kind of number that an argument takes; a validator for cyclopts.

    Attributes:
        words: Description of the kind.
        holds: Function that returns whether a number is of the kind.
    """

    words: str
    holds: Callable[[float], bool]

    def __call__(self, _: Any, value: Any) -> None:
        """Reject numbers of another kind, single or several.

        Raises:
            ValueError: A number is of another kind.
        """
        for x in value if isinstance(value, tuple | list) else (value,):
            if x is not None and not isinstance(x, str) and not self.holds(x):
                raise ValueError(f"write {self.words}")


FINITE = Kind("a finite number", isfinite)
POSITIVE = Kind("a number above zero, below 1e9", lambda x: 0 < x < 1e9)
POSITIVE_LARGE = Kind("a number above zero, below 1e15", lambda x: 0 < x < 1e15)  # a stiffness
NOT_NEGATIVE = Kind("zero or a number above it", lambda x: 0 <= x < 1e9)
WHOLE = Kind("a whole number from zero up", lambda x: x >= 0)
POSITIVE_WHOLE = Kind("a whole number above zero", lambda x: 0 < x < 1_000_000)
PORT = Kind("a port between 1 and 65535", lambda x: 0 < x < 65536)


def build_whole_kind(low: int, high: int) -> Kind:
    """Return the kind of whole numbers from `low` to `high`."""
    return Kind(f"a whole number from {low} to {high}", lambda x: low <= x <= high)


def read_whole(_: Any, tokens: Sequence[Token]) -> int:
    """Return a whole number; cyclopts would round other numbers.

    Raises:
        ValueError: The number is not whole.
    """
    text = tokens[0].value
    if "." in text and not float(text).is_integer():
        raise ValueError("write a whole number")
    return int(float(text)) if "." in text else int(text)


Positive = Annotated[float, Parameter(validator=POSITIVE)]
NotNegative = Annotated[float, Parameter(validator=NOT_NEGATIVE)]
Whole = Annotated[int, Parameter(validator=WHOLE, converter=read_whole)]
Positives = Annotated[tuple[float, ...], Parameter(validator=POSITIVE, consume_multiple=SEVERAL)]
NotNegatives = Annotated[tuple[float, ...], Parameter(validator=NOT_NEGATIVE, consume_multiple=SEVERAL)]
Finites = Annotated[tuple[float, ...], Parameter(validator=FINITE, consume_multiple=SEVERAL)]
Place = Annotated[tuple[float, float, float], Parameter(validator=FINITE, metavar="X Y Z")]
Strings = Annotated[tuple[str, ...], Parameter(consume_multiple=SEVERAL)]
Paths = Annotated[tuple[Path, ...], Parameter(consume_multiple=SEVERAL)]


def require_csv_name(_: Any, path: Any) -> None:
    """Reject an output file whose name does not end in .csv; a validator for cyclopts.

    Raises:
        ValueError: The name has another ending.
    """
    if isinstance(path, Path) and path.suffix.lower() != ".csv":
        raise ValueError("must end in .csv, the written format")


def build_destination(own: str, text: str = "", *, csv: bool = False) -> Parameter:
    """Return the parameter `--out`: the command's own file, or a run folder for this file, the result and the report.

    Args:
        own: The file's usual name in capitals, `DIR` for a command that fills a folder, `FOLDER/` for one without an own file.
        text: Help of an own file; if empty, that of the docstring.
        csv: Whether the file must be a CSV.
    """

    def convert(_: Any, tokens: Sequence[Token]) -> Path | RunFolder:
        found = read_destination(tokens[0].value, own)
        if csv:
            require_csv_name(None, found)
        return found

    told: dict[str, Any] = {"help": f"{text}; FOLDER/ takes it with result, report and run.json"} if text else {}
    return Parameter(name="--out", converter=convert, n_tokens=1, metavar=own, **told)


TABLE_OUT = Annotated[
    Path | None, build_destination("POSES.csv", "Write q_<joint>, x_tool .. qw_tool, reason here", csv=True)
]
_OUTPUT = Group("Output", sort_key=90)
_ROBOT = Group("Robot", sort_key=80)


@Parameter(name="*", group=_OUTPUT)
@dataclass(frozen=True, kw_only=True)
class Output:
    """Options of every command.

    Attributes:
        json: Write the result here; - writes only the result, to stdout
        report: Write one self-contained page here
        seed: Seed of everything random
        quiet: No progress, no result on the screen; warnings stay
        verbose: Log each step on stderr
    """

    json: Annotated[Path | None, Parameter(metavar="FILE")] = None
    report: Annotated[Path | None, Parameter(metavar="FILE.html")] = None
    seed: Whole = 0
    quiet: bool = False
    verbose: bool = False


@Parameter(name="*", group=_OUTPUT)
@dataclass(frozen=True, kw_only=True)
class FolderOutput(Output):
    """Options of commands without an own file.

    Attributes:
        out: Folder for result, report and run.json (inputs, options, versions)
    """

    out: Annotated[Path | None, build_destination("FOLDER/")] = None


_A_XACRO = "(a xacro is code: it evaluates Python)"
RobotName = Annotated[
    str,
    Parameter(help=f"A .urdf, .urdf.xacro or MJCF .xml file, or a short name that `tau-dyn robots` lists {_A_XACRO}"),
]


def describe_robot_or_model(brings: str) -> Parameter:
    """Return the help of ROBOT for commands that also take a model file; `brings` describes its effect."""
    return Parameter(
        help=f"A .urdf, .urdf.xacro or MJCF .xml file, a short name that `tau-dyn robots` lists {_A_XACRO}, "
        f"or a model file MODEL.yaml of identify or diagnose, {brings}"
    )


@Parameter(name="*", group=_ROBOT)
@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """Options for loading a robot.

    Attributes:
        set: Xacro argument or dimension, such as prototype=d1, or a .yaml file with several
        actuated: Actuated joints, if not those with a transmission or in ros2_control
        tool: Tool frame, if not tool, tool0, tcp, ee_link, flange or the tree's only leaf
        package: Folder of a ROS package, if not around the file, in AMENT_PREFIX_PATH or ROS_PACKAGE_PATH
        srdf: An SRDF that names passive joints, if not the one of the same name next to the file
        fitted_inertias: Accept physically inconsistent inertias, such as those fitted to forces
        no_xacro: Accept plain URDF only; refuse xacro files, because they run code. Built-in robots are xacro files too
        hold: Hold a joint still at this position [m or rad]
        base: floating for a walking robot, with the base pose in the log; only for identify, diagnose, payload, check and columns
        contact: Links with intermittent ground contact: FRAME for a point foot, FRAME=RADIUS for a ball [m], FRAME=flat
    """

    set: Annotated[tuple[str, ...], Parameter(metavar="NAME=VALUE")] = ()
    actuated: Annotated[Strings, Parameter(metavar="JOINT")] = ()
    tool: Annotated[str | None, Parameter(metavar="FRAME")] = None
    package: Annotated[tuple[str, ...], Parameter(metavar="NAME=DIR")] = ()
    srdf: Annotated[Path | None, Parameter(metavar="FILE")] = None
    fitted_inertias: bool = False
    no_xacro: bool = False
    hold: Annotated[tuple[str, ...], Parameter(metavar="JOINT=VALUE")] = ()
    base: Literal["fixed", "floating"] = "fixed"
    contact: Annotated[Strings, Parameter(metavar="FRAME")] = ()

    def load(self, robot: str | Path, *, may_float: bool = False) -> Robot:
        """Load a robot: a robot file, a built-in robot, or the `--out` file of a calibration.

        Args:
            robot: Its path or short name.
            may_float: Whether the command takes a floating base.

        Raises:
            InputError: Options do not apply, or the file holds no robot.
        """
        from tau_dyn.robot import load_robot

        if self.base == "floating" and not may_float:
            raise InputError("bad_option", "--base floating goes with identify, diagnose, payload, check and columns")
        given = read_arguments(self.set)
        for name, instead in _ELSEWHERE.items():
            if name in given:
                raise InputError("bad_option", f"--set {name}=...: {instead}")
        if is_model_file(robot):
            return self._load_calibrated(Path(robot), given)
        return load_robot(
            str(robot), actuated=self.actuated or None, tool=self.tool, xacro=not self.no_xacro,
            packages=self._read_packages(), srdf=self.srdf, fitted_inertias=self.fitted_inertias,
            hold=self._read_held(), base=self.base, contacts=self.contact, **given,
        )  # fmt: skip

    def hold_silent_joints(self, machine: Robot, robot: str | Path, logs: Sequence[Log | Recording]) -> Robot:
        """Return the robot with joints held still that neither move the tool nor occur in a log, such as a gripper's."""
        if self.actuated or machine.loops or is_model_file(robot):
            return machine
        names = {name for log in logs for name in log.channels}
        carrying = machine.carrying_joints
        kept = [j for j in machine.actuated if j in carrying or not names.isdisjoint((f"q_{j}", f"tau_{j}"))]
        return (
            machine if len(kept) in (0, machine.na) else replace(self, actuated=tuple(kept)).load(robot, may_float=True)
        )

    def load_model(self, robot: str | Path) -> Model:
        """Load the model that ROBOT names: a model file with its effects, or a rigid robot.

        Raises:
            InputError: Options do not apply, or the file holds neither.
        """
        from tau_dyn.model import Model

        if not is_saved_model(robot):
            return Model.of(self.load(robot))
        if self.set or self.actuated or self.hold:
            raise InputError(
                "bad_option",
                f"{robot} is a model file, which carries its own robot; leave --set, --actuated and --hold out",
            )
        return Model.load(robot)

    def _read_held(self) -> dict[str, float]:
        """Return the positions of held joints by name."""
        found = {}
        for text in self.hold:
            name, _, value = text.partition("=")
            try:
                found[name] = float(value)
            except ValueError as fault:
                raise InputError("bad_option", f"--hold {text}: write JOINT=VALUE, such as elbow=0.5") from fault
        return found

    def _read_packages(self) -> dict[str, str]:
        pairs = {text: text.partition("=") for text in self.package}
        for text, (name, _, folder) in pairs.items():
            if not name or not folder:
                raise InputError(
                    "bad_option", f"--package {text}: write NAME=DIR, such as ur_description=src/ur_description"
                )
        return {name: folder for name, _, folder in pairs.values()}

    def _load_calibrated(self, path: Path, given: dict[str, str]) -> Robot:
        from tau_dyn.files import read_yaml

        content = read_yaml(path)
        if not isinstance(content, dict) or "tau_dyn_calibration" not in content:
            raise InputError(
                "file_format",
                f"{path}: a robot file ends in .urdf or .urdf.xacro, a calibration's begins with tau_dyn_calibration; "
                "is it a model file? A robot file is needed here",
            )
        if given or self.actuated or self.tool or self.package or self.srdf or self.hold:
            raise InputError("bad_option", f"{path}: a calibrated robot has its arguments, joints and tool already")
        from tau_dyn.calibrate import load_calibration

        return load_calibration(path).build_robot(str(path))

    def list_files(self, robot: str | Path) -> list[Path]:
        """Return the robot's or the model's file and files of dimensions, for the list of inputs."""
        from tau_dyn.robot import find_robot

        dimensions = [Path(text) for text in self.set if "=" not in text]
        more = [*dimensions, *([self.srdf] if self.srdf else [])]
        return [Path(robot) if is_model_file(robot) else find_robot(str(robot)), *more]


_ELSEWHERE = {
    "actuated": "actuated joints are named with --actuated JOINT ...",
    "xacro": "--no-xacro refuses every xacro",
    "tool": "the tool frame is named with --tool FRAME",
}
"""Names that are not xacro arguments, and the option to use instead."""


def read_arguments(texts: Sequence[str]) -> dict[str, str]:
    """Return xacro arguments and dimensions of `--set`; NAME=VALUE overrides a file."""
    from tau_dyn.robot import read_dimensions_file

    from_files, given = {}, {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals and is_model_file(text):
            from_files |= read_dimensions_file(text)
        elif not equals or not name:
            raise InputError(
                "bad_option", f"--set {text}: write NAME=VALUE, such as prototype=d1, or name a .yaml of dimensions"
            )
        else:
            given[name] = value
    return from_files | given


def is_model_file(path: str | Path) -> bool:
    """Return whether a path names a model file rather than a robot."""
    return Path(path).suffix.lower() in (".yaml", ".yml")


def is_saved_model(path: str | Path) -> bool:
    """Return whether a path names a model file rather than a robot or a calibrated robot."""
    if not is_model_file(path) or not Path(path).is_file():
        return is_model_file(path)
    with Path(path).open("rb") as file:
        return not file.readline().startswith(b"tau_dyn_calibration")


def list_words(options: Any) -> list[str]:
    """Return options that differ from their defaults as the words of a command line.

    Args:
        options: An instance of one of the dataclasses of options.
    """
    words: list[str] = []
    for one in fields(options):
        value, name = getattr(options, one.name), f"--{one.name.replace('_', '-')}"
        if value == one.default:
            continue
        given = value if isinstance(value, tuple) else (value,)
        words += [name] if value is True else [word for x in given for word in (name, str(x))]
    return words


ColumnMapFile = Annotated[Path | None, Parameter(metavar="MAP.yaml", help="How to read foreign column names and units")]
CHOICES = Group("Parameters, by name or pattern")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FittingOptions:
    """Options of `identify` and `diagnose` for a model that is fitted to logs.

    Attributes:
        fix: Hold the nominal value, set a value, or give a value measured in advance with its standard error
        free: Estimate parameters that are fixed by default, such as *.armature
        bound: Constrain the estimate
        exclude: Leave out samples where this column is not zero
    """

    columns: ColumnMapFile = None
    fix: Annotated[tuple[str, ...], Parameter(group=CHOICES, metavar="NAME[=VALUE[+-SIGMA]]")] = ()
    free: Annotated[tuple[str, ...], Parameter(group=CHOICES, metavar="NAME")] = ()
    bound: Annotated[tuple[str, ...], Parameter(group=CHOICES, metavar="NAME=LO:HI")] = ()
    exclude: Annotated[tuple[str, ...], Parameter(metavar="COLUMN")] = ()

    def open_logs(self, paths: Sequence[str]) -> list[Log | Recording]:
        """Return logs; large logs remain on disk."""
        from tau_dyn.log import open_log

        return [open_log(path, self.columns) for path in paths]

    def read_logs(self, paths: Sequence[str]) -> list[Log]:
        """Return logs in memory.

        Raises:
            InputError: A log is too large.
        """
        from tau_dyn.log import Log

        opened = self.open_logs(paths)
        for log in opened:
            if not isinstance(log, Log):
                raise InputError(
                    "file_too_large",
                    f"{log.name} has {log.n_samples} samples, too many for this command; give an excerpt "
                    "(identify takes it whole)",
                )
        return [log for log in opened if isinstance(log, Log)]

    def collect(self, model: str, seed: int) -> dict[str, Any]:
        """Return the keyword arguments of `identify` and `diagnose`, without the logs."""
        from tau_dyn.identify import Choices

        choices = Choices(self.fix, self.free, self.bound)
        return {"model": model, "choices": choices, "exclude": self.exclude, "seed": seed}

    def list_inputs(self, model: str, paths: Sequence[str], logs: Sequence[Log | Recording]) -> list[Any]:
        """Return the input files without the robot's; logs with the hash from their reader."""
        read = [(str(path), log.sha256) for path, log in zip(paths, logs, strict=True)]
        return [*read, *(p for p in (self.columns, Path(model)) if p is not None and p.is_file())]


Logs = Annotated[
    tuple[str, ...],
    Parameter(
        name="LOG",
        help="CSV, Parquet, MCAP, a ROS bag or .mat with t, q_JOINT, tau_JOINT; or a folder of Parquet files; each log is "
        "processed separately",
    ),
]


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Read a table's columns by name."""
    from tau_dyn.log import parse_delimited

    try:
        data = read_bytes(path)
    except OSError as fault:
        raise InputError("cannot_read", f"{path}: cannot be read ({fault.strerror})") from fault
    return parse_delimited(str(path), data)[0]
