"""Contents of a robot file beyond the plain tree: transmissions, loops, couplings, friction, and hints of `tau_dyn`.

Read from the expanded URDF. `<drake:ball_constraint>` closes loops (the same element Drake reads), and so does `<constraint>`,
which urdfdom's pull request 264 proposes. Motors are named by `<transmission>` and by `<ros2_control>`. `<tau_dyn:...>`
elements are hints that no other program needs: the parameters of a link, a home position, a known closed form, mass that only
gravity acts on, springs on compliant joints, the ratio of a slide's travel to its drive's reading, and the values of the file
that are assumed rather than measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, suggest_nearest
from tau_dyn.robot.floating_base import FLAT, POINT, ContactFrame
from tau_dyn.robot.gazebo import refuse_gazebo_loops, write_gazebo_mimics
from tau_dyn.robot.numbers import (
    MAX_NUMBER,
    build_rotation,
    check_names,
    check_numbers,
    check_parents,
    check_tree,
    combine_axes,
    parse_numbers,
)

_DRAKE = ("http://drake.mit.edu", "https://drake.mit.edu")
_OURS = "urn:tau_dyn"
_POINTS = {
    "spherical": ((0.0, 0.0, 0.0),),
    "ball": ((0.0, 0.0, 0.0),),
    "revolute": ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0)),
    "fixed": ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)),
}
"""Points [m] in a `<constraint>`'s frame, with its axis along x, that coincide for each type of constraint that points can
represent."""


@dataclass(frozen=True)
class BallConstraint:
    """A point of one link that coincides with a point of another; points in link frames (3,) [m]."""

    link_a: str
    link_b: str
    point_a: tuple[float, float, float]
    point_b: tuple[float, float, float]


@dataclass(frozen=True)
class Transmission:
    """An actuated joint and its drive's inertia seen at the joint [kg or kg m^2]; None if the file gives no rotor inertia.

    `ratio` is the gear ratio, in motor turns per turn of the joint or radians per metre; 1 if the file has no ratio.
    """

    joint: str
    armature: float | None
    ratio: float = 1.0


@dataclass(frozen=True)
class ArmNames:
    """One arm of a simplified Gantry-Tau: its cart joint, cart link and rod link."""

    cart_joint: str
    cart_link: str
    rod_link: str


@dataclass(frozen=True)
class Spring:
    """A spring on a joint: `force = -stiffness * deflection - damping * velocity`, deflection zero when unloaded.

    Attributes:
        joint: A joint of one degree of freedom. A passive joint deflects itself; an actuated one has the spring between drive
            and link.
        stiffness: [N/m or N m/rad].
        damping: [N s/m or N m s/rad].
        stiffness_stderr: Standard error of the stiffness [N/m or N m/rad]; None if the file does not state it.
    """

    joint: str
    stiffness: float
    damping: float
    stiffness_stderr: float | None = None


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another one: `position = multiplier * position of joint + offset` [m or rad].

    Attributes:
        joint: The joint that it follows.
        multiplier: Ratio of its position to that of the other joint.
        offset: Its position when the other joint is at zero.
    """

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class JointFriction:
    """A joint's friction in a robot file: `viscous` [N s/m or N m s/rad] and `coulomb` [N or N m]."""

    viscous: float
    coulomb: float


@dataclass(frozen=True)
class Annotations:
    """All contents of the file beyond the plain tree."""

    joints: dict[str, str]  # movable joint -> child link
    links: tuple[str, ...]
    leaves: tuple[str, ...]  # links that carry no other
    loops: tuple[BallConstraint, ...]
    transmissions: tuple[Transmission, ...]
    mass_only: frozenset[str]
    home: dict[str, float]
    gantry_tau_arms: tuple[ArmNames, ...]
    gantry_tau_plate: str
    gravity_masses: dict[str, float]
    springs: tuple[Spring, ...]
    drive_springs: tuple[Spring, ...]
    assumed: tuple[str, ...]
    mimics: dict[str, Mimic]
    friction: dict[str, JointFriction]
    warnings: tuple[str, ...]
    estimated: bool  # its inertias are fitted to data, and need not be those of bodies
    shared_drives: tuple[tuple[str, str], ...] = ()  # pairs of joints in one <transmission>
    drive_scales: dict[str, float] = field(default_factory=dict)  # joint -> travel per reading
    floating: bool = False  # six joints without motors place its base
    contacts: tuple[ContactFrame, ...] = ()


def read_annotations(urdf: str, where: str) -> Annotations:
    """Read transmissions, loops and hints from URDF text.

    Raises:
        InputError: An element lacks an attribute, names a link or joint that does not exist, or is not a number.
    """
    try:
        root = fromstring(urdf, forbid_dtd=True)
    except DefusedXmlException as fault:
        raise InputError("file_format", f"{where}: a robot file may not declare a document type or entities") from fault
    except ParseError as fault:
        raise InputError("robot_structure", f"{where}: not well-formed XML ({fault})") from fault
    if root.tag != "robot":
        raise InputError("robot_structure", f"{where}: the root element is <{root.tag}>, a robot file's is <robot>")
    check_tree(root, where)
    check_names(root.iter(), where)
    check_numbers(root, where)
    check_parents(root, where)
    write_gazebo_mimics(root)
    reader = _Reader(root, where)
    refuse_gazebo_loops(root, where)
    mechanism = reader.ours("mechanism")
    return Annotations(
        joints=reader.joints,
        links=tuple(reader.links),
        leaves=reader.leaves(),
        loops=reader.loops(),
        transmissions=reader.transmissions(),
        mass_only=frozenset(reader.link_of(e, "name") for e in reader.ours("link") if e.get("parameters") == "mass"),
        home={reader.joint_of(e, "joint"): reader.number(e, "value") for e in reader.ours("home")},
        gantry_tau_arms=tuple(reader.arm(a) for m in mechanism for a in m.findall(f"{{{_OURS}}}arm")),
        gantry_tau_plate=mechanism[0].get("plate", "") if mechanism else "",
        gravity_masses={reader.link_of(e, "link"): reader.number(e, "value") for e in reader.ours("gravity_mass")},
        springs=reader.springs(),
        drive_springs=reader.drive_springs(),
        assumed=tuple(e.get("what", "") for e in reader.ours("assumed")),
        mimics=reader.mimics(),
        friction=reader.friction(),
        warnings=(*(f"{where}: {e.get('text', '')}" for e in reader.ours("warning")), *reader.list_absent()),
        estimated=bool(reader.ours("estimated_inertias")),
        shared_drives=reader.shared_drives(),
        drive_scales=reader.drive_scales(),
        floating=bool(reader.ours("floating_base")),
        contacts=reader.contacts(),
    )


class _Reader:
    """Finds elements and turns their attributes into names that exist and numbers that are finite."""

    def __init__(self, root: Element, where: str) -> None:
        self.root, self.where = root, where
        self.absent: list[str] = []  # joints with a motor that the file lacks, as files of a part of a robot name them
        self.links = [e.get("name", "") for e in root.findall("link")]
        movable = [e for e in root.findall("joint") if e.get("type") != "fixed"]
        self.joints = {e.get("name", ""): self._child(e) for e in movable}
        self.fixed = {e.get("name", "") for e in root.findall("joint") if e.get("type") == "fixed"}
        both = set(self.links) & {e.get("name", "") for e in root.findall("joint")}
        if both:
            raise InputError(
                "robot_structure", f"{where}: '{min(both)}' names both a link and a joint; end link names in _link"
            )

    def mimics(self) -> dict[str, Mimic]:
        found = {}
        for joint in self.root.findall("joint"):
            element = joint.find("mimic")
            if element is not None and joint.get("type") != "fixed":
                found[joint.get("name", "")] = self._read_mimic(element)
        return self._controlled_mimics() | found

    def _read_mimic(self, element: Element) -> Mimic:
        share, offset = (
            self.number(element, key) if element.get(key) is not None else default
            for key, default in (("multiplier", 1.0), ("offset", 0.0))
        )
        return Mimic(self.joint_of(element, "joint"), share, offset)

    def _controlled_mimics(self) -> dict[str, Mimic]:
        """Return the joints that `<ros2_control>` lets follow others."""
        found = {}
        for joint in self.root.findall("ros2_control/joint"):
            said = {e.get("name", ""): (e.text or "").strip() for e in joint.findall("param")}
            name = joint.get("name", "")
            if "mimic" in said and name in self.joints:
                element = Element("mimic", {"joint": said["mimic"], "multiplier": said.get("multiplier", "1")})
                found[name] = Mimic(self.joint_of(element, "joint"), self.number(element, "multiplier"), 0.0)
        return found

    def friction(self) -> dict[str, JointFriction]:
        """Return the friction in `<dynamics>` of the joints that have some."""
        found = {}
        for joint in self.root.findall("joint"):
            element, name = joint.find("dynamics"), joint.get("name", "")
            if element is not None and name in self.joints:
                values = [
                    self.number(element, key) if element.get(key) is not None else 0.0
                    for key in ("damping", "friction")
                ]
                if min(values) < 0:
                    raise InputError(
                        "robot_structure",
                        f"{self.where}: joint '{name}': <dynamics> gives friction or damping of {min(values):g}, which is never "
                        "below zero",
                    )
                if any(values):
                    found[name] = JointFriction(*values)
        return found

    def leaves(self) -> tuple[str, ...]:
        parents = {e.get("link") for e in self.root.findall("joint/parent")}
        return tuple(link for link in self.links if link not in parents)

    def _child(self, joint: Element) -> str:
        child = joint.find("child")
        return child.get("link", "") if child is not None else ""

    def ours(self, tag: str) -> list[Element]:
        return self.root.findall(f"{{{_OURS}}}{tag}")

    def joint_of(self, element: Element, attribute: str) -> str:
        return self._existing(element, attribute, list(self.joints), "joint")

    def link_of(self, element: Element, attribute: str) -> str:
        return self._existing(element, attribute, self.links, "link")

    def _existing(self, element: Element, attribute: str, known: list[str], kind: str) -> str:
        name = element.get(attribute, "")
        if name not in known:
            tag = element.tag.split("}")[-1]
            raise InputError(
                "robot_structure", f"{self.where}: <{tag}> names {kind} '{name}'; there are {', '.join(known)}"
            )
        return name

    def number(self, element: Element, attribute: str) -> float:
        return self._numbers(element, attribute, 1)[0]

    def _numbers(self, element: Element, attribute: str, count: int) -> tuple[float, ...]:
        text = element.get(attribute, "")
        values = parse_numbers(text)
        if len(values) != count or not all(abs(v) < MAX_NUMBER for v in values):
            tag = element.tag.split("}")[-1]
            raise InputError(
                "robot_structure", f"{self.where}: <{tag} {attribute}='{text}'> must hold {count} finite number(s)"
            )
        return values

    def loops(self) -> tuple[BallConstraint, ...]:
        found = []
        for namespace in _DRAKE:
            for element in self.root.findall(f"{{{namespace}}}ball_constraint"):
                part = {
                    p: element.find(f"{{{namespace}}}ball_constraint_{p}") for p in ("body_A", "body_B", "p_AP", "p_BQ")
                }
                missing = [p for p, e in part.items() if e is None]
                if missing:
                    raise InputError(
                        "robot_structure",
                        f"{self.where}: a <drake:ball_constraint> lacks <drake:ball_constraint_{missing[0]}>",
                    )
                a, b, p_a, p_b = (e for e in part.values() if e is not None)
                point_a, point_b = self._numbers(p_a, "value", 3), self._numbers(p_b, "value", 3)
                found.append(BallConstraint(self.link_of(a, "name"), self.link_of(b, "name"), point_a, point_b))  # type: ignore[arg-type]
        return (*found, *(ball for element in self.root.findall("constraint") for ball in self._constraint(element)))

    def _constraint(self, element: Element) -> list[BallConstraint]:
        """Return a proposed `<constraint>` as coinciding points: one for a ball, two for a hinge, three for a rigid one."""
        name, kind = element.get("name", ""), element.get("type", "")
        if kind not in _POINTS:
            known = ", ".join(_POINTS)
            raise InputError(
                "unsupported", f"{self.where}: <constraint name='{name}' type='{kind}'>: loops are closed by {known}"
            )
        ends = []
        for side in ("parent", "child"):
            link, origin, axis = (element.find(tag) for tag in (side, f"{side}_origin", f"{side}_axis"))
            if link is None:
                raise InputError("robot_structure", f"{self.where}: <constraint name='{name}'> lacks <{side}>")
            place, turn, along = (
                self._numbers(e, key, 3) if e is not None and e.get(key) is not None else default
                for e, key, default in (
                    (origin, "xyz", (0.0,) * 3),
                    (origin, "rpy", (0.0,) * 3),
                    (axis, "xyz", (1.0, 0.0, 0.0)),
                )
            )
            if not any(along):
                raise InputError(
                    "robot_structure", f"{self.where}: <constraint name='{name}'>: its {side}_axis is zero"
                )
            axes = build_rotation(turn) @ combine_axes(along)
            ends.append((self.link_of(link, "link"), [axes @ point + place for point in _POINTS[kind]]))
        (a, points_a), (b, points_b) = ends
        return [
            BallConstraint(a, b, tuple(p.tolist()), tuple(q.tolist())) for p, q in zip(points_a, points_b, strict=True)
        ]

    def transmissions(self) -> tuple[Transmission, ...]:
        """Return the joints with a motor: those of transmissions, then those that `<ros2_control>` commands."""
        found: dict[str, Transmission] = {}
        for element in self.root.findall("transmission"):
            for joint in element.findall("joint"):
                actuators = element.findall("actuator")
                drives = [self._reflected_inertia(actuator, joint) for actuator in actuators]
                given = [inertia for inertia in drives if inertia is not None]
                if joint.get("name") not in self.fixed and not self._is_absent(joint):
                    name = self.joint_of(joint, "name")
                    if name not in found or given:
                        ratio = self._find_ratio(actuators[0], joint) if len(actuators) == 1 else None
                        found[name] = Transmission(name, sum(given) if given else None, abs(ratio or 1.0))
        for joint in self.root.findall("ros2_control/joint"):
            named = joint.find("command_interface") is not None and joint.get("name") not in self.fixed
            if named and not self._is_absent(joint):
                name = self.joint_of(joint, "name")
                found.setdefault(name, Transmission(name, None))
        return tuple(found.values())

    def _is_absent(self, joint: Element) -> bool:
        """Return whether the file has neither a motor's joint nor one of a similar name, and keep its name."""
        name = joint.get("name", "")
        absent = bool(name) and name not in self.joints and not suggest_nearest(name, self.joints)
        self.absent += [name] if absent else []
        return absent

    def list_absent(self) -> list[str]:
        """Return a sentence about motors of joints that the file lacks; empty without one."""
        names = ", ".join(dict.fromkeys(self.absent))
        return [f"{self.where}: motors of joints that the file lacks are left out: {names}"] if names else []

    def shared_drives(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs of joints that one transmission drives, such as a differential's."""
        found = []
        for element in self.root.findall("transmission"):
            names = [joint.get("name", "") for joint in element.findall("joint")]
            found += [pair for pair in combinations(dict.fromkeys(names), 2)]
        return tuple(found)

    def drive_scales(self) -> dict[str, float]:
        """Return the travel [m] of slides per metre that their drives read: `<tau_dyn:drive joint="" scale=""/>`."""
        sliding = {e.get("name") for e in self.root.findall("joint") if e.get("type") == "prismatic"}
        found: dict[str, float] = {}
        for element in self.ours("drive"):
            name, scale = self.joint_of(element, "joint"), self.number(element, "scale")
            if name in found or name not in sliding or scale <= 0:
                why = "is no prismatic joint" if name not in sliding else "needs one scale above zero"
                raise InputError("robot_structure", f"{self.where}: <drive> of '{name}': it {why}")
            found[name] = scale
        return found

    def contacts(self) -> tuple[ContactFrame, ...]:
        """Return the feet: `<tau_dyn:contact link="" kind="" radius="" centre=""/>`."""
        found = []
        for element in self.ours("contact"):
            link, kind = self.link_of(element, "link"), element.get("kind", POINT)
            if kind not in (POINT, FLAT):
                raise InputError("robot_structure", f"{self.where}: <contact link='{link}'> is neither point nor flat")
            radius = self.number(element, "radius") if element.get("radius") is not None else 0.0
            centre = self._numbers(element, "centre", 3) if element.get("centre") is not None else (0.0, 0.0, 0.0)
            found.append(ContactFrame(link, kind, radius, centre))  # type: ignore[arg-type]
        return tuple(found)

    def springs(self) -> tuple[Spring, ...]:
        driven, found = {t.joint for t in self.transmissions()}, {}
        for element in self.ours("spring"):
            name = self.joint_of(element, "joint")
            if name in found or name in driven:
                why = "has a <transmission>" if name in driven else "has two springs"
                raise InputError(
                    "robot_structure",
                    f"{self.where}: joint '{name}' {why}; a <tau_dyn:spring> is for a passive joint, the spring "
                    "between a drive and its link is a <tau_dyn:drive_spring>",
                )
            found[name] = self._spring(element, name)
        return tuple(found.values())

    def drive_springs(self) -> tuple[Spring, ...]:
        """Return the springs between drives and links, at most one per joint."""
        found: dict[str, Spring] = {}
        for element in self.ours("drive_spring"):
            name = self.joint_of(element, "joint")
            if name in found:
                raise InputError("robot_structure", f"{self.where}: the drive of joint '{name}' has two springs")
            found[name] = self._spring(element, name)
        return tuple(found.values())

    def _spring(self, element: Element, joint: str) -> Spring:
        damping = self.number(element, "damping") if element.get("damping") is not None else 0.0
        stderr = self.number(element, "stiffness_stderr") if element.get("stiffness_stderr") is not None else None
        spring = Spring(joint, self.number(element, "stiffness"), damping, stderr)
        if spring.stiffness <= 0 or spring.damping < 0:
            raise InputError(
                "robot_structure",
                f"{self.where}: the spring on '{joint}' needs a stiffness above and a damping from zero up",
            )
        if stderr is not None and stderr < 0:
            raise InputError(
                "robot_structure", f"{self.where}: the spring on '{joint}' has a standard error below zero"
            )
        return spring

    def _reflected_inertia(self, actuator: Element, joint: Element) -> float | None:
        """Return a rotor's inertia seen through its gear."""
        inertia = self._drake_value(actuator, "rotor_inertia")
        if inertia is None:
            return None
        ratio = self._find_ratio(actuator, joint)
        return inertia * (1.0 if ratio is None else ratio) ** 2

    def _find_ratio(self, actuator: Element, joint: Element) -> float | None:
        """Return a gear ratio, Drake's or ROS' `<mechanicalReduction>`; None if the file has no ratio."""
        ratio = self._drake_value(actuator, "gear_ratio")
        for element in (actuator, joint):
            if ratio is None and (text := element.findtext("mechanicalReduction")) is not None:
                values = parse_numbers(text)
                if len(values) != 1 or not abs(values[0]) < 1e12:
                    raise InputError(
                        "robot_structure",
                        f"{self.where}: <mechanicalReduction>{text[:40]}</...> must be one finite number",
                    )
                ratio = values[0]
        return ratio

    def _drake_value(self, actuator: Element, tag: str) -> float | None:
        for namespace in _DRAKE:
            element = actuator.find(f"{{{namespace}}}{tag}")
            if element is not None:
                return self.number(element, "value")
        return None

    def arm(self, element: Element) -> ArmNames:
        return ArmNames(
            self.joint_of(element, "cart"), self.joints[element.get("cart", "")], self.link_of(element, "rod")
        )
