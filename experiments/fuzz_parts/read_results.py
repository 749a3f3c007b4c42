"""Readers of what commands wrote: results, run folders, progress, journals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fuzz_parts import seed_results, seeds
from fuzz_parts.reader import JOURNAL, JSON, YAML, Reader, axis, of, pendulum


def _compared(path: Path) -> None:
    from tau_dyn.cli.execute import format_json
    from tau_dyn.compare import compare, read_side
    from tau_dyn.render import build_page

    side = read_side(path)
    found = compare(side, side)
    format_json(found.to_dict())
    build_page(found, command_line="tau-dyn compare a b")


def _progress(path: Path) -> None:
    from tau_dyn.calibrate.poses import read_progress

    read_progress(path, ("axis",)).measured()


def _shown(compute: bool) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        from tau_dyn.view import read_result

        read_result(path, axis().robot if compute else pendulum(), compute=compute)

    return read


def _run_folder(path: Path, name: str) -> Path:
    """Return a run folder in which this file stands under a name."""
    folder = path.parent / f"run_with_{name}"
    folder.mkdir(exist_ok=True)
    files = {"result.json": seeds.as_json(seeds.IDENTIFY)[0], "run.json": seeds.as_json(seeds.RUN)[0]}
    for each, data in {**files, name: path.read_bytes()}.items():
        (folder / each).write_bytes(data)
    return folder


def _run(path: Path) -> None:
    """Compare a run folder with itself, make the page, and ask whether a run may be written to it."""
    from tau_dyn.cli.run_folder import RunFolder
    from tau_dyn.exceptions import InputError

    folder = _run_folder(path, "run.json")
    _compared(folder)
    try:
        RunFolder(folder).check("identify", {"robot": "r.urdf"}, set())
    except InputError as fault:
        if len(str(fault)) > 1000:
            raise


def _journal(path: Path) -> None:
    from tau_dyn.scale import run_journaled

    list(run_journaled(float, range(6), path))


RESULTS = (
    Reader("result", ".json", lambda f: seeds.as_json(seeds.IDENTIFY, seeds.DIAGNOSE, seeds.MODES, seeds.CALIBRATE),
           JSON, _compared),
    Reader("compared_model", ".yaml", lambda f: [seeds.model_file(f)], YAML, _compared, 2),
    Reader("run", ".json", of(*seeds.as_json(seeds.RUN)), JSON, _run),
    Reader("run_result", ".json", of(*seeds.as_json(seeds.IDENTIFY, seed_results.REFUSED)), JSON,
           lambda path: _compared(_run_folder(path, "result.json"))),
    Reader("view_result", ".json", lambda f: seeds.as_json(seeds.DIAGNOSE, *seed_results.TO_SHOW), JSON, _shown(False)),
    Reader("view_computed", ".json", seed_results.to_compute, JSON, _shown(True)),
    Reader("progress", ".json", of(*seeds.as_json(seeds.PROGRESS)), JSON, _progress),
    Reader("journal", ".jsonl", lambda f: [seeds.journal(f)], JOURNAL, _journal),
)  # fmt: skip
"""Each with its share of time."""
