"""Valid files that a xacro of a user's takes in: a table of dimensions, macros; and what stands around a linear axis."""

from __future__ import annotations

DIMENSIONS = b"""mass: 95.0
stroke: [-0.5, 0.5]
speed: 1
name: carriage
inertia: {xx: 1.0, yy: 2.0, zz: 2.5}
turned: 30
"""
MACROS = b"""<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="length" value="0.5"/>
  <xacro:macro name="body" params="name mass:=2.0 size:=${[1, 1, 1]}"><link name="${name}_link"><inertial><mass value="${mass}"/>
    <inertia ixx="${mass*(size[1]**2 + size[2]**2)/12}" ixy="0" ixz="0" iyy="${mass/12}" iyz="0" izz="${mass/12}"/>
    </inertial></link>
  </xacro:macro>
</robot>
"""
AROUND = b"""limits: {x: [-2, 2.5], z: [-1, .inf]}
obstacles:
  - {name: table, box: {centre: [0, 0, -1], size: [1, 1, 0.1], rpy: [0, 0, 0.1]}, margin: 0.05, blocks: robot}
  - {name: ball, sphere: {centre: [0.4, 0.1, 0], radius: 0.2}, blocks: tool}
  - {name: post, cylinder: {centre: [0, 1, 0], radius: 0.1, height: 2, axis: [0, 0, 1]}}
  - {name: floor, half_space: {point: [0, 0, -2], normal: [0, 0, 1]}}
"""
_AXIS = """<robot name="axis" xmlns:xacro="http://www.ros.org/wiki/xacro">
{}
  <link name="base_link"/>
{}
  <joint name="axis" type="prismatic"><parent link="base_link"/><child link="carriage_link"/><axis xyz="1 0 0"/>
    <limit lower="{}" upper="{}" velocity="{}" effort="500"/></joint>
  <transmission name="d"><joint name="axis"/><actuator name="a"/></transmission>
</robot>
"""


def with_table(name: str) -> bytes:
    """Return a xacro that takes its dimensions from a YAML file of this name beside it."""
    table = f"""  <xacro:property name="d" value="${{xacro.load_yaml('{name}')}}"/>"""
    body = """  <link name="${d['name']}_link"><inertial><origin rpy="0 0 ${radians(d['turned'])}"/><mass value="${d['mass']}"/>
    <inertia ixx="${d['inertia']['xx']}" ixy="0" ixz="0" iyy="${d['inertia'].yy}" iyz="0" izz="${d.inertia.zz}"/>
    </inertial></link>"""
    return _AXIS.format(table, body, "${d['stroke'][0]}", "${d.stroke[1] + 0.0}", "${d['speed']}").encode()


def with_include(name: str) -> bytes:
    """Return a xacro that includes a file of this name beside it and uses its macro."""
    body = """  <xacro:body name="carriage" mass="${2 * length}"/>"""
    return _AXIS.format(f"""  <xacro:include filename="{name}"/>""", body, "${-length}", "${length}", "1").encode()
