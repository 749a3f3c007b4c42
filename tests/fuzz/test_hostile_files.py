"""Files made to harm: bombs, code, files elsewhere, pipes and devices; each is refused, soon, and nothing runs."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from raising import raises_code

from tau_dyn import files
from tau_dyn.cli import COMMANDS, build_app, main
from tau_dyn.cli.app import list_options
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes, read_yaml
from tau_dyn.log import ColumnMap, read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}<link name="base_link"/></robot>'
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {x: 1}\n" + "".join(
    f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 9)}]}}\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
ENTITIES = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>'
OUTSIDE = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/hostname">]><robot name="&a;"/>'
PARAMETER = '<!DOCTYPE r [<!ENTITY % p SYSTEM "http://localhost/x">%p;]><robot name="r"/>'


def robot(folder: Path, content: str, name: str = "r.urdf.xacro") -> Path:
    """Write a robot file."""
    path = folder / name
    path.write_text(content)
    return path


@pytest.mark.parametrize("bomb", [BOMB, MERGES, "a: &a [*a]\n", "a: &a {b: *a}\n", "x: " + "[" * 50_000, "- " * 2_000])
@pytest.mark.parametrize("read", [read_yaml, ColumnMap.load])
def test_aliases_merges_and_brackets_without_end_are_refused_soon(tmp_path: Path, read, bomb: str) -> None:
    """A few lines of YAML that would be 10^9 entries, hold themselves, or use up the stack."""
    path = tmp_path / "bomb.yaml"
    path.write_text(bomb)
    begun = time.process_time()
    with raises_code("file_format", "bomb.yaml"):
        read(path)
    assert time.process_time() - begun < 3.0


@pytest.mark.parametrize(
    "text",
    ["!!python/object/apply:os.system [echo]", "!!python/name:os.system", "!radians '1+1'", "!degrees 3", "!!int ''", "!!float _",
     "!!timestamp soon", "!!bool maybe", "2026-13-01", "1:1:" + "1:" * 500 + "1.5", "9" * 5000, "0x" + "f" * 5000],
)  # fmt: skip
@pytest.mark.parametrize("read", [read_yaml, ColumnMap.load])
def test_tags_and_numbers_that_are_none_are_refused(tmp_path: Path, read, text: str) -> None:
    """No object is ever made from a tag, and PyYAML's own slips on odd scalars become sentences."""
    path = tmp_path / "tag.yaml"
    path.write_text(f"q_axis: {text}\n")
    with raises_code("file_format", "tag.yaml"):
        read(path)


def test_what_xacro_adds_to_the_yaml_loader_does_not_reach_our_files(tmp_path: Path) -> None:
    """A xacro that loads a table evaluates `!radians`; neither PyYAML's safe loader nor our own learns it."""
    (tmp_path / "table.yaml").write_text("angle: !radians 1.0\n")
    include = "<xacro:property name='t' value=\"${xacro.load_yaml('table.yaml')}\"/><link name=\"l${t['angle']}\"/>"
    with raises_code("robot_structure"):
        load_robot(robot(tmp_path, XACRO.format(include)))
    assert "!radians" not in yaml.SafeLoader.yaml_constructors
    (tmp_path / "model.yaml").write_text("value: !radians 2*3\n")
    with raises_code("file_format", "model.yaml"):
        read_yaml(tmp_path / "model.yaml")


@pytest.mark.parametrize(
    "content", [ENTITIES, OUTSIDE, PARAMETER, "<?xml version='1.0'?><!DOCTYPE robot><robot name='r'/>"]
)
@pytest.mark.parametrize("name", ["r.urdf", "r.urdf.xacro"])
def test_document_types_are_refused_whatever_they_declare(tmp_path: Path, content: str, name: str) -> None:
    """Entities that grow, files and addresses elsewhere: none is looked at."""
    with raises_code("file_format"):
        load_robot(robot(tmp_path, content, name))


@pytest.mark.parametrize(
    "code",
    [
        "(lambda: ().__class__.__base__.__subclasses__())()",
        "[c for c in [k.__class__ for k in [1]]]",
        "python.vars(python.type)['__subclasses__'](float.mro()[1])",
        "[g.gi_frame.f_back.f_globals for g in [(x for x in [1])]]",
        "'%s' % (lambda f: f.func_globals)(len)",
        "str.format('%s', 1)",
        "__import__('os').system('true')",
        "xacro.load_yaml.__globals__",
        "math.__loader__",
        "1" + " + 1" * 4000,
        "9**9**9",
        "2**(10**9)",
    ],
)
@pytest.mark.parametrize("form", ["${%s}", "$(eval %s)"])
def test_no_way_leads_from_an_expression_to_python(tmp_path: Path, code: str, form: str) -> None:
    """A look at outermost names is no wall; nested functions, frames, classes and formats are looked at as well."""
    text = (form % code).replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    with raises_code("file_format") as fault:
        load_robot(robot(tmp_path, XACRO.format(f'<link name="{text}"/>')))
    assert "Pinocchio" not in str(fault.value)


def test_expressions_that_robots_use_still_work(tmp_path: Path) -> None:
    """Sums, conditions, lists, comprehensions and xacro's own functions."""
    value = "${sum([x * 2 for x in python.range(3)]) + max(1, 2) + (1 if pi > 3 else 0)}".replace("sum", "python.sum")
    value = value.replace(">", "&gt;")
    inner = (
        f'<xacro:property name="v" value="{value}"/><link name="a_link"><inertial><mass value="${{v}}"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
        '<joint name="a" type="prismatic"><parent link="base_link"/><child link="a_link"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    assert load_robot(robot(tmp_path, XACRO.format(inner))).parameters["a_link.mass"].value == 9.0


def test_a_plain_urdf_is_never_evaluated(tmp_path: Path, write) -> None:
    """An expression in a file that is no xacro is a name like any other."""
    path = robot(tmp_path, write.block().replace('name="block"', 'name="${1/0}"'), "r.urdf")
    assert load_robot(path, xacro=False).name == load_robot(path).name == "${1/0}"


def test_no_xacro_refuses_by_name_and_by_namespace(tmp_path: Path, write) -> None:
    """Also a xacro called .urdf, and those that come along."""
    named = robot(tmp_path, XACRO.format(""), "sly.urdf")
    for given in (named, robot(tmp_path, write.block()), "linear_axis"):
        with raises_code("unsupported"):
            load_robot(given, xacro=False)


def test_every_command_that_takes_a_robot_takes_no_xacro() -> None:
    """A command whose robot is loaded without the option would leave a gap."""
    app = build_app()
    for name in COMMANDS:
        options = list_options(app, name)
        assert ("--set" in options) == ("--no-xacro" in options), name


@pytest.mark.parametrize(
    "argv",
    [("check", "log.csv", "ROBOT"), ("simulate", "ROBOT", "--out", "x.csv"), ("identify", "ROBOT", "log.csv"),
     ("fk", "ROBOT", "--q", "0"), ("excite", "ROBOT", "--out", "x.csv"), ("workspace", "ROBOT"), ("view", "ROBOT"),
     ("calibrate", "ROBOT", "log.csv")],
)  # fmt: skip
def test_no_xacro_on_the_command_line(tmp_path: Path, refused, argv: tuple[str, ...]) -> None:
    """The option reaches the loader: a xacro that would be refused for another reason is refused for being one."""
    path = robot(tmp_path, XACRO.format('<link name="${nonsense}"/>'))
    (tmp_path / "log.csv").write_text("t,q_axis,tau_axis\n" + "".join(f"{k / 10},{k % 3},0\n" for k in range(20)))
    said = refused(*(str(path) if word == "ROBOT" else word for word in argv), "--no-xacro")
    assert "is a xacro, which is code" in said


def test_elements_deep_inside_each_other_and_trees_of_thousands_are_refused(tmp_path: Path, write) -> None:
    """Parsers written in C go down one call a level and would take the process with them."""
    deep = write.block().replace("</robot>", "<a>" * 5000 + "</a>" * 5000 + "</robot>")
    for name in ("r.urdf", "r.urdf.xacro"):
        with raises_code("robot_structure", "100"):
            load_robot(robot(tmp_path, deep, name))
    many = write.block().replace("</robot>", "".join(f'<link name="k{k}_link"/>' for k in range(1200)) + "</robot>")
    with raises_code("robot_structure", "1202"):
        load_robot(robot(tmp_path, many, "r.urdf"))


def test_a_column_map_reaches_no_file_outside_the_logs_folder(tmp_path: Path) -> None:
    """Neither up, nor absolute, nor through a home folder, a drive or an end of text."""
    for path in ("../secret.csv", "/etc/passwd", "~/x.csv", "a/../../x.csv", "C:\\x.csv", "\\\\host\\x", "a\0b", ""):
        with raises_code("file_format"):
            ColumnMap.from_dict({"files": {"a": path}, "t": {"column": "t", "file": "a"}})


@pytest.mark.skipif(sys.platform == "win32", reason="no such files there")
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null", "/dev/tty"])
def test_devices_are_not_read(device: str) -> None:
    """One of them never ends, another waits for a person."""
    for read in (read_log, read_yaml, ColumnMap.load, read_bytes):
        with pytest.raises((InputError, OSError)) as fault:
            read(device)
        assert isinstance(fault.value, InputError) or device == "/dev/tty"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes by name there")
def test_a_pipe_nobody_writes_into_is_refused_and_one_with_a_writer_is_read(tmp_path: Path, monkeypatch) -> None:
    """`open` would wait for a writer without end; a shell's `<(command)` has one and is read."""
    pipe, content = tmp_path / "pipe.yaml", b"a: 1\n" * 3
    os.mkfifo(pipe)
    monkeypatch.setattr(files, "_PATIENCE", 0.2)
    for read in (read_yaml, ColumnMap.load, read_log):
        with raises_code("cannot_read"):
            read(pipe)
    monkeypatch.setattr(files, "_PATIENCE", 20.0)
    writer = threading.Thread(target=pipe.write_bytes, args=(content,))
    writer.start()
    assert read_bytes(pipe) == content
    writer.join()


def test_links_are_followed_and_broken_or_circular_ones_refused(tmp_path: Path) -> None:
    """A link is its user's wish; one that leads nowhere is named."""
    (tmp_path / "real.yaml").write_text("a: 1\n")
    (tmp_path / "good.yaml").symlink_to("real.yaml")
    assert read_yaml(tmp_path / "good.yaml") == {"a": 1}
    (tmp_path / "broken.yaml").symlink_to("gone.yaml")
    (tmp_path / "circle.yaml").symlink_to("circle.yaml")
    for name in ("broken", "circle"):
        with pytest.raises(InputError, match=name):
            read_yaml(tmp_path / f"{name}.yaml")


def test_sizes_without_end_are_refused_before_they_are_read(tmp_path: Path) -> None:
    """A sparse file of a terabyte takes no room on the disk."""
    path = tmp_path / "huge.yaml"
    with path.open("wb") as file:
        file.truncate(2**40)
    with raises_code("file_too_large"):
        read_yaml(path)
    with raises_code("file_too_large"):
        load_robot(path.rename(tmp_path / "huge.urdf"))


def _readers() -> dict[str, Callable[[Path], object]]:
    """Return the readers that once opened whatever stood at a path."""
    from tau_dyn.calibrate.poses import read_progress
    from tau_dyn.cli.arguments import read_columns
    from tau_dyn.compare import read_side
    from tau_dyn.view import read_cloud, read_result
    from tau_dyn.vision.images import read_image

    return {
        "compare": read_side,
        "view": lambda path: read_result(path, load_robot("linear_axis")),
        "cloud": read_cloud,
        "progress": lambda path: read_progress(path, ("axis",)),
        "poses": read_columns,
        "image": read_image,
    }


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes by name there")
@pytest.mark.parametrize("name", ["compare", "view", "cloud", "progress", "poses", "image"])
def test_no_reader_waits_at_a_pipe_or_reads_a_device_without_end(tmp_path: Path, monkeypatch, name: str) -> None:
    """Results, clouds, poses and images, too: `cat result.json > pipe` that never comes, `/dev/zero`."""
    pytest.importorskip("cv2" if name == "image" else "numpy")
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr(files, "_PATIENCE", 0.1)
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with raises_code("cannot_read"):
            _readers()[name](path)


def test_a_packed_cloud_is_not_inflated(tmp_path: Path) -> None:
    """By its name `.gz`, pandas opened it, and 0.5 MB became 300; clouds are read as they stand."""
    (tmp_path / "c.csv.gz").write_bytes(gzip.compress(b"x,y,z\n" + b"0,0,0\n" * 1000))
    with raises_code("file_format"):
        _readers()["cloud"](tmp_path / "c.csv.gz")


def test_a_picture_of_gigapixels_is_refused(tmp_path: Path, monkeypatch) -> None:
    """A PNG of 2 MB declares a billion grey values of 16 bits, which became eight gigabytes of floats."""
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr("tau_dyn.vision.images._MAX_PIXELS", 10_000)
    (tmp_path / "x.png").write_bytes(bytes(cv2.imencode(".png", np.zeros((101, 100), np.uint16))[1]))
    with raises_code("file_format", "100x101"):
        _readers()["image"](tmp_path / "x.png")


def _run(folder: Path) -> None:
    assert main(["fk", "linear_axis", "--q", "0.1", "--quiet", "--out", f"{folder}/"]) == 0


def test_a_run_folder_with_links_leads_to_nothing_outside(tmp_path: Path) -> None:
    """Files of an earlier run that are links to other places: the rerun replaces the links, what they led to stays."""
    folder, outside = tmp_path / "run", tmp_path / "outside"
    _run(folder)
    outside.mkdir()
    for path in list(folder.iterdir()):
        if path.name != "run.json":
            path.rename(outside / path.name)
            path.symlink_to(outside / path.name)
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in outside.iterdir()}
    _run(folder)
    assert {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in outside.iterdir()} == before
    assert not any(path.is_symlink() for path in folder.iterdir())


def test_a_run_folder_whose_list_names_files_elsewhere_removes_none(tmp_path: Path) -> None:
    """`run.json` says what a rerun may replace: paths that lead out are no names of its files."""
    folder = tmp_path / "run"
    _run(folder)
    (tmp_path / "mine.csv").write_text("mine")
    held = json.loads((folder / "run.json").read_text())
    digest = hashlib.sha256(b"mine").hexdigest()
    held["files"] |= {"../mine.csv": digest, str(tmp_path / "mine.csv"): digest, "..": "", "": "", ".": ""}
    (folder / "run.json").write_text(json.dumps(held))
    _run(folder)
    assert (tmp_path / "mine.csv").read_text() == "mine" and (folder / "run.json").is_file()


def test_a_model_that_names_a_file_as_its_robot_never_opens_it(tmp_path: Path, monkeypatch) -> None:
    """What a model says of where its robot came from is a word for people; the robot is inside."""
    Model.of(load_robot("linear_axis")).save(tmp_path / "m.yaml")
    content = yaml.safe_load((tmp_path / "m.yaml").read_text())
    content["robot"]["source"] = "/dev/zero"
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(content))
    monkeypatch.chdir(tmp_path)
    assert main(["compare", "m.yaml", "m.yaml", "--quiet", "--json", "c.json"]) == 0
    assert main(["export", "m.yaml", "--to", "urdf", "--quiet", "--out", "m.urdf"]) == 0
