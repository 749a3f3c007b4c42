"""How large and how tangled is the source? Lines and files by package, folders, circles, imports past a package's face, paths.

    python experiments/house.py [--traced] [--out FILE.json]

A function has one caller where its name occurs once in all of `src` beside its definition. Files and functions that `identify`
and `diagnose` pass are counted by a profile of both on one simulated log of the L1 (60 s, seed 1), set-up and import left out.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).resolve().parents[1] / "src" / "tau_dyn"
MAX_FILES = 25  # in a folder (house style)


def read_modules() -> dict[str, ast.Module]:
    """Return the parsed modules by dotted name."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        name = ".".join(("tau_dyn", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


def list_packages() -> set[str]:
    """Return the packages' dotted names."""
    return {".".join(("tau_dyn", *p.parent.relative_to(SOURCE).parts)) for p in SOURCE.rglob("__init__.py")}


def list_large_folders() -> dict[str, int]:
    """Return how many files stand in each folder that holds more than `MAX_FILES`."""
    folders = Counter(str(p.parent.relative_to(SOURCE)) for p in SOURCE.rglob("*.py"))
    return {folder: n for folder, n in folders.items() if n > MAX_FILES}


def get_room(module: str) -> str:
    """Return the package directly below `tau_dyn` that a module belongs to."""
    return module.split(".")[1] if "." in module else ""


def list_imports(tree: ast.AST, modules: dict[str, ast.Module]) -> set[tuple[str, str]]:
    """Return (module, name) of what is imported from this package, also inside functions and for type checking."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "tau_dyn":
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add((full if full in modules else str(node.module), alias.name))
    return found


def list_deep_imports(modules: dict[str, ast.Module]) -> list[str]:
    """Return imports of another package's modules instead of the package."""
    packages = list_packages()
    return sorted(
        f"{here}: {there} {name}"
        for here, tree in modules.items()
        for there, name in list_imports(tree, modules)
        if get_room(there) != get_room(here) and there.count(".") > 1 and there not in packages
    )


def list_circles(modules: dict[str, ast.Module]) -> list[str]:
    """Return groups of modules that import each other, inside functions too (strongly connected components)."""
    edges = {m: {t for t, _ in list_imports(tree, modules) if t != m} for m, tree in modules.items()}

    def reach(start: str) -> set[str]:
        seen, todo = set(), [start]
        while todo:
            for nxt in edges.get(todo.pop(), ()):
                if nxt not in seen:
                    seen.add(nxt)
                    todo.append(nxt)
        return seen

    reached = {m: reach(m) for m in modules}
    groups = {frozenset(t for t in reached[m] if m in reached[t]) for m in modules if m in reached[m]}
    return sorted(" ".join(sorted(group)) for group in groups)


def list_single_caller_functions(modules: dict[str, ast.Module]) -> list[str]:
    """Return module functions whose name occurs once beside their definition."""
    uses: Counter[str] = Counter()
    for tree in modules.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Name):
                uses[node.id] += 1
            elif isinstance(node, ast.Attribute):
                uses[node.attr] += 1
    return sorted(
        f"{m}.{node.name}"
        for m, tree in modules.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and uses[node.name] == 1
    )


def list_mechanism_branches(modules: dict[str, ast.Module]) -> list[str]:
    """Return where the kind of a mechanism is asked for outside its own package."""
    kinds = re.compile(r"\b(Rods|TreePose|SlidingPlate|FreePlate|GantryTauMechanism|TreeMechanism|PlateOnLegs)\b")
    return sorted(
        f"{m}:{node.lineno}"
        for m, tree in modules.items()
        if get_room(m) != "mechanism"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "isinstance"
        and kinds.search(ast.unparse(node.args[1]))
    )


def count_passed(run: Callable[[], Any]) -> tuple[Any, dict[str, int]]:
    """Return what a call returns, and how many of our files and functions it passes."""
    passed: set[tuple[str, str]] = set()

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(SOURCE)):
            passed.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    sys.setprofile(note)
    try:
        result = run()
    finally:
        sys.setprofile(None)
    functions = {(file, name) for file, name in passed if not name.split(".")[-1].startswith("<")}
    return result, {"files": len({file for file, _ in functions}), "functions": len(functions)}


def trace() -> dict[str, dict[str, int]]:
    """Return what `identify` and `diagnose` pass."""
    import tau_dyn as td
    from tau_dyn.cli.demo import make_gantry
    from tau_dyn.simulate import Sensors, build_named_motion

    made = make_gantry(1)
    motion = build_named_motion("fourier", made.truth, 60.0, 1)
    robot, log = made.robot, td.simulate(made.truth, motion, sensors=Sensors(**made.sensors), seed=1)
    td.identify(robot, log)  # what loads on first use is loaded
    found, identified = count_passed(lambda: td.identify(robot, log))
    _, diagnosed = count_passed(lambda: td.diagnose(found))
    return {"identify": identified, "diagnose": diagnosed}


def measure() -> dict[str, Any]:
    """Return all figures but the traced ones."""
    modules = read_modules()
    files = {p: p.read_text(encoding="utf-8").count("\n") for p in SOURCE.rglob("*.py")}
    rooms: dict[str, dict[str, int]] = {}
    for path, lines in sorted(files.items()):
        room = rooms.setdefault(path.relative_to(SOURCE).parts[0], {"lines": 0, "files": 0})
        room["lines"] += lines
        room["files"] += 1
    return {
        "lines": sum(files.values()),
        "files": len(files),
        "rooms": rooms,
        "large_folders": list_large_folders(),
        "single_caller_functions": len(list_single_caller_functions(modules)),
        "circles": list_circles(modules),
        "deep_imports": len(list_deep_imports(modules)),
        "mechanism_branches": list_mechanism_branches(modules),
    }


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--traced", action="store_true", help="also profile identify and diagnose (a minute)")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    figures = measure() | ({"passed": trace()} if arguments.traced else {})
    text = json.dumps(figures, indent=1)
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
