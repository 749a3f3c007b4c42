"""Commands as readers: `tau-dyn COMMAND ...` on one hostile file, with all that is promised of how a command ends.

Exit status 0, 2 or 3. With 2: one printable sentence, and every file as it was. Otherwise whole files only: JSON without numbers
that are none, pages to their last tag, tables to their last line. Nothing temporary stays behind.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path

from fuzz_parts import seed_motions, seed_robots, seeds
from fuzz_parts.reader import JSON, TABLE, XML, YAML, Reader, of

LONGEST_LINE = 1200
_FILES: dict[str, Callable[[Path], bytes]] = {
    "robot.urdf": lambda f: seeds.PENDULUM.encode(),
    "axis.urdf.xacro": lambda f: seeds.XACRO.encode(),
    "log.csv": lambda f: seeds.csv_of(seeds.columns()),
    "loop.csv": lambda f: seeds.csv_of(seeds.loop_columns()),
    "law.yaml": lambda f: seeds.SERVO_LAW,
    "foreign_log.csv": lambda f: seeds.foreign_log(),
    "second_log.csv": lambda f: seeds.foreign_log(),
    "motion.csv": lambda f: seed_motions.motion(),
    "at_rest.csv": lambda f: seed_motions.at_rest(),
    "poses.csv": lambda f: seeds.csv_of(seeds.poses()),
    "points.csv": lambda f: seed_motions.guideway(),
    "good.json": lambda f: seeds.as_json(seeds.IDENTIFY)[0],
}
"""Good files that stand beside the case."""


def command(*lines: str, out: str = "out_of_ours") -> Callable[[Path], None]:
    """Return a reader that runs command lines one after the other until one refuses.

    Args:
        lines: Words of a command line; `CASE` is the file, `HERE/` the folder of good files, `OUT/` the folder of results.
        out: Name of that folder, which is emptied first unless it is named here.
    """

    def read(path: Path) -> None:
        here, results = path.parent / "of_ours", path.parent / out
        _lay_out(here)
        if out == "out_of_ours":
            shutil.rmtree(results, ignore_errors=True)
            results.mkdir()
        stands = {"CASE": str(path), "HERE/": f"{here}/", "OUT/": f"{results}/"}
        for line in lines:
            _run([_filled(word, stands) for word in line.split()], results)

    return read


def _filled(word: str, stands: dict[str, str]) -> str:
    for short, long in stands.items():
        word = word.replace(short, long)
    return word


@cache
def _lay_out(here: Path) -> None:
    here.mkdir(exist_ok=True)
    for name, made in _FILES.items():
        (here / name).write_bytes(made(here))


def _run(words: Sequence[str], out: Path) -> None:
    """Run one command, check how it ended, and raise what it said where it refused."""
    from tau_dyn.cli import main
    from tau_dyn.exceptions import CannotAnswer, InputError

    before, said, shown = _all_in(out), io.StringIO(), io.StringIO()
    with redirect_stderr(said), redirect_stdout(shown):
        status = main(words)
    lines = [line for line in said.getvalue().splitlines() if line.strip()]
    after = _all_in(out)
    if status not in (0, 2, 3):
        raise AssertionError(f"exit status {status}: {lines[-1:]}")
    if any(not line.isprintable() or len(line) > LONGEST_LINE for line in lines):
        raise AssertionError(f"no printable sentence: {lines}")
    if status == 2 and (len(lines) != 1 or not lines[0].startswith("error: ")):
        raise AssertionError(f"not one sentence: {lines}")
    if status == 2 and after != before:
        raise AssertionError(f"refused, and yet wrote {sorted(set(after) ^ set(before)) or 'over a file'}")
    for name, data in after.items():
        if data != before.get(name):
            _check_whole(out / name)
    if status == 2:
        raise InputError("invalid_value", lines[0])
    if status == 3:
        raise CannotAnswer("not_identifiable", " ".join(lines), "")


def _all_in(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _check_whole(path: Path) -> None:
    """Refuse half a file."""
    data = path.read_bytes()
    if path.suffix == ".part":
        raise AssertionError(f"{path.name} was left behind")
    if path.suffix == ".json":
        json.loads(data, parse_constant=_no_number)
    if path.suffix == ".html" and not data.rstrip().endswith(b"</html>"):
        raise AssertionError(f"{path.name} is half a page")
    if path.suffix in (".csv", ".yaml", ".c", ".h", ".py", ".urdf", ".xml") and not data.endswith(b"\n"):
        raise AssertionError(f"{path.name} ends in the middle of a line")


def _no_number(text: str) -> None:
    raise AssertionError(f"{text} in JSON")


_AGAIN = "fk linear_axis --q 0.1 --quiet --out OUT/"


def _rerun(path: Path) -> None:
    """Run into the folder of an earlier run whose `run.json` is the case; a file beside the folder must stay."""
    folder, mine = path.parent / "run_of_ours", path.parent / "mine.txt"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(_earlier_run(path.parent), folder)
    (folder / "run.json").write_bytes(path.read_bytes())
    mine.write_text("mine")
    command(_AGAIN, out=folder.name)(path)
    if mine.read_text() != "mine":
        raise AssertionError("a file beside the run folder was changed")


@cache
def _earlier_run(folder: Path) -> Path:
    """Return the folder of a run."""
    made = folder / "earlier_run_of_ours"
    command(_AGAIN, out=made.name)(folder / "no_case")
    return made


def _runs(folder: Path) -> list[bytes]:
    """Return `run.json` of a run, and one that lists a file beside its folder."""
    real = (_earlier_run(folder) / "run.json").read_bytes()
    about = json.loads(real)
    outside = {"../mine.txt": hashlib.sha256(b"mine").hexdigest()}
    return [real, json.dumps({**about, "files": {**about["files"], **outside}}).encode()]


_R = "HERE/robot.urdf"
_SENT = "--resample --period 0.01"
_ANSWER = "--json OUT/r.json --report OUT/r.html"
COMMANDS = (
    Reader("tau-dyn check", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE, command(f"check CASE {_R} {_ANSWER}"), 3),
    Reader("tau-dyn check --columns", ".yaml", of(*seeds.COLUMN_MAPS), YAML,
           command(f"check HERE/foreign_log.csv --columns CASE {_ANSWER}"), 3),
    Reader("tau-dyn fk", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE,
           command(f"fk {_R} --poses CASE --out OUT/p.csv {_ANSWER}"), 3),
    Reader("tau-dyn ik", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE,
           command(f"ik {_R} --poses CASE --out OUT/p.csv {_ANSWER}"), 6),
    Reader("tau-dyn compare", ".json", lambda f: seeds.as_json(seeds.IDENTIFY, seeds.DIAGNOSE, seeds.MODES, seeds.CALIBRATE),
           JSON, command(f"compare CASE CASE {_ANSWER}"), 2),
    Reader("tau-dyn export", ".yaml", lambda f: [seeds.model_file(f)], YAML,
           command("export CASE --to urdf --out OUT/m.urdf", "export CASE --to mjcf --out OUT/m.xml"), 3),
    Reader("tau-dyn feedforward", ".yaml", lambda f: [seeds.model_file(f)], YAML,
           command("feedforward export CASE --to python --steady --out OUT/f.py",
                   "feedforward export CASE --to c --steady --out OUT/f.c"), 5),
    Reader("tau-dyn simulate", ".urdf", of(seeds.PENDULUM.encode()), XML,
           command("simulate CASE --motion HERE/motion.csv --out OUT/log.csv --json OUT/r.json"), 4),
    Reader("tau-dyn simulate --effects", ".yaml", of(seeds.EFFECTS), YAML,
           command(f"simulate {_R} --motion HERE/motion.csv --effects CASE --out OUT/log.csv --json OUT/r.json"), 3),
    Reader("tau-dyn simulate --motion", ".csv", lambda f: [seed_motions.motion()], TABLE,
           command(f"simulate {_R} --motion CASE --out OUT/log.csv --json OUT/r.json"), 3),
    Reader("tau-dyn export --motion", ".csv", lambda f: [seed_motions.at_rest()], TABLE,
           command(f"export {_R} --to reference {_SENT} --motion CASE --out OUT/ref.csv --json OUT/r.json",
                   f"export {_R} --to rapid {_SENT} --motion CASE --out OUT/m.mod"), 2),
    Reader("tau-dyn export --correction", ".csv", lambda f: [seed_motions.learned(f)], TABLE,
           command(f"export {_R} --to reference {_SENT} --motion HERE/at_rest.csv --correction CASE --out OUT/ref.csv"), 3),
    Reader("tau-dyn accuracy --errors", ".yaml", of(b"actuators: {all: 0.0001, axis: {along: 0.0001}}\n"), YAML,
           command(f"accuracy {_R} --errors CASE --poses HERE/poses.csv --method linear montecarlo --samples 5 {_ANSWER}"), 3),
    Reader("tau-dyn accuracy --measured", ".csv", of(seed_motions.guideway()), TABLE,
           command(f"accuracy linear_axis --measured CASE --method linear --poses HERE/points.csv {_ANSWER}"), 5),
    Reader("tau-dyn workspace --obstacles", ".yaml", of(seed_robots.AROUND), YAML,
           command(f"workspace linear_axis --obstacles CASE --resolution 0.2 --out OUT/w.csv {_ANSWER}"), 5),
    Reader("tau-dyn plan-poses --resume", ".json", lambda f: seeds.as_json(seeds.PROGRESS), JSON,
           command(f"plan-poses {_R} --resume CASE --out OUT/left.csv --rapid OUT/left.mod"), 2),
    Reader("tau-dyn calibrate", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE,
           command(f"calibrate {_R} CASE --model frames --out OUT/c.yaml {_ANSWER}"), 4),
    Reader("tau-dyn identify", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE,
           command(f"identify {_R} CASE --out OUT/m.yaml {_ANSWER}"), 3),
    Reader("tau-dyn identify --controller", ".yaml", of(seeds.SERVO_LAW), YAML,
           command(f"identify {_R} HERE/loop.csv --controller CASE {_ANSWER}"), 4),
    Reader("tau-dyn identify commands", ".csv", lambda f: [seeds.csv_of(seeds.loop_columns())], TABLE,
           command(f"identify {_R} CASE --controller HERE/law.yaml {_ANSWER}"), 4),
    Reader("tau-dyn simulate --controller", ".yaml", of(seeds.SERVO_LAW), YAML,
           command(f"simulate {_R} --motion HERE/motion.csv --controller CASE --out OUT/log.csv --json OUT/r.json"), 3),
    Reader("tau-dyn identify --samples", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE,
           command(f"identify {_R} CASE --samples 2 --out OUT/m.parquet {_ANSWER}"), 3),
    Reader("tau-dyn modes", ".csv", lambda f: [seed_motions.shaken()], TABLE,
           command(f"modes CASE --inputs tau_axis --outputs q_axis --order 2 --out OUT/m.yaml {_ANSWER}"), 4),
    Reader("tau-dyn excite --noise-from", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE,
           command(f"excite {_R} --noise-from CASE --method random --trials 1 --duration 5 --rate 100 --out OUT/m.csv"), 4),
    Reader("tau-dyn plan-motion --path", ".csv", of(seed_motions.way()), TABLE,
           command("plan-motion linear_axis --from -0.3 0 0 --to 0.3 0 0 --path CASE --nodes 12 --rate 100 --out OUT/m.csv"), 4,
           needs=("casadi",)),
    Reader("tau-dyn plan-poses --camera", ".yaml", of(seeds.CAMERA), YAML,
           command(f"plan-poses {_R} --camera CASE --n 4 --candidates 20 --out OUT/p.csv"), 4),
    Reader("tau-dyn plan-poses --tracker", ".yaml", of(seeds.TRACKER.replace(b"incidence: 30", b"incidence: 85")), YAML,
           command(f"plan-poses {_R} --tracker CASE --n 20 --candidates 100 --out OUT/p.csv"), 4),
    Reader("tau-dyn --out", ".json", _runs, JSON, _rerun, 3),
)  # fmt: skip
"""Each with its share of time."""
