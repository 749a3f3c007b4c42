"""Mutations of robot files: elements and attributes lost, doubled, moved; cyclic trees, entities, includes, expressions."""

from __future__ import annotations

import re
from random import Random
from xml.sax.saxutils import quoteattr

from fuzz_parts.hostile import value

_ATTRIBUTE = re.compile(rb'\s([\w:.-]+)=("[^"]*"|\'[^\']*\')')
_ELEMENT = re.compile(rb"<([\w:.-]+)(\s[^<>]*)?/>|<([\w:.-]+)(\s[^<>]*)?>[^<]*</\3>")
_VECTORS = (
    "0 0 0",
    "0 0 nan",
    "1e308 1e308 1e308",
    "1 0",
    "0 0 1 0",
    "1e-300 0 0",
    "",
    "a b c",
    "inf 0 0",
    "1,0,0",
    "0x1 0 0",
)
_KINDS = ("revolute", "prismatic", "continuous", "fixed", "floating", "planar", "ball", "", "Revolute", "mimic")


def _quoted(text: str) -> bytes:
    return quoteattr(text).encode("utf-8", "replace")


def attribute(data: bytes, rng: Random) -> bytes:
    """Give some attributes other values: hostile ones, or another attribute's."""
    for _ in range(rng.choice((1, 1, 2, 6))):
        found = list(_ATTRIBUTE.finditer(data))
        if not found:
            return data
        one, other = rng.choice(found), rng.choice(found)
        new = rng.choice((_quoted(value(rng)), other[2], _quoted(rng.choice(_VECTORS)), _quoted(rng.choice(_KINDS))))
        data = data[: one.start(2)] + new + data[one.end(2) :]
    return data


def attributes(data: bytes, rng: Random) -> bytes:
    """Lose, double or rename an attribute."""
    found = list(_ATTRIBUTE.finditer(data))
    if not found:
        return data
    one = rng.choice(found)
    new = rng.choice((b"", one[0] + one[0], b" " + rng.choice(found)[1] + b"=" + one[2], one[0].replace(b"=", b" = ")))
    return data[: one.start()] + new + data[one.end() :]


def element(data: bytes, rng: Random) -> bytes:
    """Lose, double, move or rename an element."""
    found = list(_ELEMENT.finditer(data))
    if not found:
        return data
    one, other = rng.choice(found), rng.choice(found)
    match rng.randrange(4):
        case 0:
            return data[: one.start()] + data[one.end() :]
        case 1:
            return data[: one.end()] + one[0] * rng.choice((1, 1, 30)) + data[one.end() :]
        case 2:
            return data[: other.end()] + one[0] + data[other.end() :]
        case _:
            name = one[1] or one[3]
            return data[: one.start()] + one[0].replace(name, other[1] or other[3] or b"x") + data[one.end() :]


def joints(data: bytes, rng: Random) -> bytes:
    """Hang links on each other anew: cycles, two parents, islands, names twice."""
    links = re.findall(rb'<link name="([^"]*)"', data) or [b"a"]
    places = list(re.finditer(rb'(<(?:parent|child) link=|<joint name=|<link name=)"([^"]*)"', data))
    for one in reversed(rng.sample(places, min(len(places), rng.choice((1, 2, 4))))):
        data = data[: one.start(2)] + rng.choice(links) + data[one.end(2) :]
    return data


_INNER = (
    b'<xacro:include filename="%s"/>',
    b'<xacro:property name="p" value="%s"/>',
    b'<xacro:if value="%s"><link name="z_link"/></xacro:if>',
    b'<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>',
    b'<xacro:macro name="m" params="a:=%s *b"/><xacro:m a="1"/>',
    b'<xacro:insert_block name="%s"/>',
    b'<xacro:call macro="%s"/>',
    b'<xacro:property name="p" value="${p}"/><link name="${p}"/>',
    b'<link name="${%s}"/>',
    b'<link name="$(arg %s)"/>',
    b'<xacro:arg name="%s" default="1"/>',
    b'<xacro:element xacro:name="%s"/>',
    b'<link name="$${x}$(x"/>',
    b"<!--%s-->",
    b"<![CDATA[%s]]>",
    b"<?x %s?>",
    b'<tau_dyn:home joint="axis" value="%s"/>',
    b'<tau_dyn:spring joint="axis" stiffness="%s"/>',
    b'<tau_dyn:gravity_mass link="%s" value="1"/>',
    b'<tau_dyn:mechanism plate="%s"/>',
    b'<mimic joint="%s"/>',
    b"<drake:ball_constraint/>",
    b'<drake:ball_constraint><drake:ball_constraint_body_A name="%s"/></drake:ball_constraint>',
)
_DOCUMENTS = (
    b'<!DOCTYPE r [<!ENTITY a "b">]>',
    b'<!DOCTYPE r SYSTEM "file:///etc/passwd">',
    b'<!DOCTYPE r [<!ENTITY % p SYSTEM "http://x/">%p;]>',
    b'<?xml version="1.0" encoding="utf-16"?>',
    b'<?xml version="9"?>',
    b'<?xml version="1.0" encoding="nothing"?>',
)


def inner(data: bytes, rng: Random) -> bytes:
    """Put an element of xacro, Drake or ours at the end, or a document type at the top."""
    if rng.random() < 0.15:
        return rng.choice(_DOCUMENTS) + data
    text = rng.choice(_INNER)
    text = text.replace(b"%s", _quoted(value(rng))[1:-1]) if b"%s" in text else text
    at = data.rfind(b"</robot>") if rng.random() < 0.8 else data.find(b">", rng.randrange(len(data) + 1)) + 1
    return data[:at] + text + data[at:]


def depth(data: bytes, rng: Random) -> bytes:
    """Nest elements deeply."""
    n, name = rng.choice((50, 500, 5000, 20000)), rng.choice((b"link", b"a", b"xacro:if value='1'", b"visual"))
    at = data.rfind(b"</robot>")
    return (
        data[:at]
        + b"<"
        + name
        + b">"
        + (b"<" + name + b">") * n
        + (b"</" + name.split(b" ")[0] + b">") * (n + 1)
        + data[at:]
    )


def chain(data: bytes, rng: Random) -> bytes:
    """Hang a long chain of links on the first link."""
    first = re.search(rb'<link name="([^"]*)"', data)
    at, n = data.rfind(b"</robot>"), rng.choice((20, 300, 3000))
    before, parts = first[1] if first else b"base_link", []
    for k in range(n):
        name, kind = b"k%d_link" % k, rng.choice((b"revolute", b"fixed"))
        parts.append(
            b'<link name="%s"/><joint name="k%d" type="%s"><parent link="%s"/><child link="%s"/><axis xyz="0 0 1"/>'
            b'<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>' % (name, k, kind, before, name)
        )
        before = name
    return data[:at] + b"".join(parts) + data[at:]


XML = (attribute, attribute, attribute, attributes, element, joints, inner, inner)
RARE = (depth, chain)
