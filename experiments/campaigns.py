"""All long campaigns by one command: run one after the other, resumed where they stopped, passed over where they are done.

    python experiments/campaigns.py [--list] [--only NAME ...] [--jobs 2] [--out DIR]

In: nothing; each campaign is another script of this folder with its seed. Out: a folder a campaign with its tables and
`said.txt`, what it printed; `campaigns.json`, which is done, by which code and in what time. A campaign counts as done for the
code that it ran with: after a change of the package it is due again, into a fresh folder. While one runs, its last line is shown.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tau_dyn.files import write_whole
from tau_dyn.scale.journal import compute_code_hash

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Campaign:
    """One long study.

    Attributes:
        what: What it answers.
        command: Script and arguments; `{jobs}` and `{out}` are filled in.
        resumes: Whether a second call with the same folder goes on; otherwise it starts anew.
    """

    what: str
    command: str
    resumes: bool = True


def hidden(kind: str, sets: int) -> str:
    """Return the command of a hidden-effect study."""
    return f"hidden_effects.py --what {kind} --sets {sets} --seed 17 --jobs {{jobs}} --out {{out}}"


CAMPAIGNS: dict[str, Campaign] = {
    "golden": Campaign("have answers drifted", "golden.py --out {out}", resumes=False),
    "clean": Campaign("false claims on clean logs", hidden("clean", 300)),
    "feedback": Campaign("false claims under feedback", hidden("feedback", 300)),
    "single": Campaign("power and names, one hidden effect", hidden("single", 300)),
    "pairs": Campaign("two hidden effects", hidden("pairs", 100)),
    "unknown": Campaign("effects without a name", hidden("unknown", 100)),
    "recovery": Campaign("coverage of identified parameters", "recovery.py --all --seeds 50 --jobs {jobs} --out {out}"),
    "estimators": Campaign(
        "RMSE over the Cramer-Rao bound", "estimators.py --runs 200 --jobs {jobs} --out {out}", resumes=False
    ),
    "calibration": Campaign(
        "coverage of calibrated geometry", "calibration_coverage.py --runs 300 --seed 21 --case 0", resumes=False
    ),
    "modes": Campaign("accuracy of resonances", "modes_accuracy.py --runs 100 --seed 7", resumes=False),
    "fuzz": Campaign("bad and hostile input", "fuzz.py --minutes 60 --seed 0 --out {out}"),
    "exports": Campaign(
        "exported files in other programs", "exports.py --seed 0 --out {out}/exports.csv", resumes=False
    ),
    "faults": Campaign("kills, full disks, lost workers", "faults.py --runs 100 --seed 0", resumes=False),
    "mutation": Campaign("would the tests notice", "mutation.py --sample 120 --seed 0 --jobs {jobs} --out {out}"),
}


def main(names: list[str], jobs: int, out_dir: Path) -> int:
    out_dir.mkdir(parents=True, exist_ok=True)
    book = out_dir / "campaigns.json"
    done = json.loads(book.read_text()) if book.exists() else {}
    for name in names:
        entry = done.get(name, {})
        if entry.get("code") == compute_code_hash() and entry.get("status") is not None:
            print(f"{name}: done, status {entry['status']}")
            continue
        begun = time.monotonic()
        status = _run(name, jobs, _folder(out_dir, name, entry))
        spent = entry.get("seconds", 0.0) + time.monotonic() - begun
        done[name] = {"code": compute_code_hash(), "status": status, "seconds": round(spent, 1)}
        write_whole(book, json.dumps(done, indent=1) + "\n")
        print(f"{name}: status {status}, {spent:.0f} s")
    return max((done[name]["status"] for name in names), default=0)


def _folder(out_dir: Path, name: str, entry: dict) -> Path:
    """Return a campaign's folder; what other code left there makes way."""
    folder = out_dir / name
    mark = folder / "code.txt"
    other = not mark.exists() or mark.read_text() != compute_code_hash()
    if folder.exists() and (other or entry.get("status") is not None or not CAMPAIGNS[name].resumes):
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    mark.write_text(compute_code_hash())
    return folder


def _run(name: str, jobs: int, folder: Path) -> int:
    """Run a campaign to its end, its last line shown; return its exit status."""
    words = CAMPAIGNS[name].command.format(jobs=jobs, out=folder).split()
    said = folder / "said.txt"
    with said.open("ab") as file:
        child = subprocess.Popen(
            [sys.executable, str(HERE / words[0]), *words[1:]], cwd=folder, stdout=file, stderr=file
        )
    console = Console(stderr=True)
    try:
        with console.status(name) as shown:
            while child.poll() is None:
                time.sleep(1.0)
                shown.update(f"{name}: {_last_line(said)[:100]}")
    except KeyboardInterrupt:
        child.terminate()
        child.wait()
        raise SystemExit(f"{name} was interrupted; the same command goes on") from None
    return child.returncode


def _last_line(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 400))
        lines = file.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def show() -> None:
    """Print the list."""
    table = Table("campaign", "what it answers", "resumes", "command", box=None)
    for name, one in CAMPAIGNS.items():
        table.add_row(name, one.what, "yes" if one.resumes else "from the start", one.command)
    Console(width=160).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="say what there is")
    parser.add_argument("--only", nargs="+", choices=list(CAMPAIGNS), default=list(CAMPAIGNS), metavar="NAME")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("out") / "campaigns", metavar="DIR")
    args = parser.parse_args()
    sys.exit(show() if args.list else main(args.only, args.jobs, args.out.resolve()))
