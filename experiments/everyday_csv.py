"""Are CSV files as people have them read right, or refused in one true sentence?

    python experiments/everyday_csv.py [--files 10000] [--first 0] [--seed 0] [--keep DIR]

Each file holds the same kind of recording: one to three joints that move, at 50 to 2000 Hz. It is written in a random locale
(decimal sign, separator, encoding, line ends), with a random clock, and with random blanks, empty cells, units, topics and rates.
`everyday_parts/` writes it and states the expected result: the samples, or the codes of refusals that are true of the file. A
file counts as a fault if its samples differ, if it is refused though the reference says that it is read, if the refusal has
another code, no file name or more than one line, or if anything but a refusal is raised. `check` is called where a case states
what it has to find; on every fourth file `check` and `columns` are called and must answer or refuse.
Prints a table by kind of clock and of layout; exit status 1 where a fault was found, each with the seed that makes it again.
"""

import argparse
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from everyday_parts.judge import judge_case
from everyday_parts.write import build_case


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first file, to run a seed in pieces")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files with faults")
    args = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    faults = []
    for k in range(args.first, args.first + args.files):
        with TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
            case = build_case((args.seed, k), Path(folder))
            outcome, why = judge_case(case, with_commands=k % 4 == 0)
            counts[case.kind, outcome] += 1
            if outcome == "fault":
                faults.append(f"case {args.seed} {k}: {case.described}: {why}")
                print(faults[-1], flush=True)
                if args.keep is not None:
                    args.keep.mkdir(parents=True, exist_ok=True)
                    for path in Path(folder).iterdir():
                        (args.keep / f"{k}_{path.name}").write_bytes(path.read_bytes())
    kinds = sorted({kind for kind, _ in counts})
    print(f"{'kind':28}{'read':>8}{'refused':>9}{'fault':>7}")
    for kind in kinds:
        print(f"{kind:28}" + "".join(f"{counts[kind, o]:>{w}}" for o, w in (("read", 8), ("refused", 9), ("fault", 7))))
    print(f"{args.files} files, {len(faults)} faults")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
