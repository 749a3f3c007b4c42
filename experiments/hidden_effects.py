"""Does `diagnose` find what hides in a log, call it by its name, and keep silent where nothing hides?

    python experiments/hidden_effects.py [--what clean feedback single pairs unknown] [--sets 300] [--jobs 2]
                                         [--robots any] [--forms FORM ...] [--least LAMBDA] [--cluster tcp://...] [--out DIR]

In: nothing; each set is drawn from its number by `hidden_effects_parts/`, which shares no effect with the library: other
Stribeck exponents and LuGre bristles, ripple with a second harmonic, temperature with a lag, springs that slip, arctan
friction, a low-pass at 1 kHz, a base that leans, and forces that no cause explains. Out: `hidden_effects.csv`, a row a set,
written as the study goes (a second call goes on where the first stopped); `hidden_effects.txt`, the table of what was shown;
`confusion.csv`; `hidden_effects.png`, the power curve beside the Neyman-Pearson limit. A set takes about as long as its
diagnosis.
"""

import argparse
import os
import traceback
from pathlib import Path

import pandas as pd
from hidden_effects_parts.figure import power_curve
from hidden_effects_parts.judge import about, row_of
from hidden_effects_parts.robots import DRAWS
from hidden_effects_parts.sensing_forms import SENSING_FORMS
from hidden_effects_parts.sets import KNOWN_FORMS, LAMBDA, draw_set
from hidden_effects_parts.summary import confusion, sentences

from tau_dyn.files import write_whole
from tau_dyn.scale import run_many

KINDS = ("clean", "feedback", "single", "pairs", "unknown")


FORMS = {form.__name__: form for form in (*KNOWN_FORMS, *SENSING_FORMS)}
"""Forms by name; those of sensors are drawn where `--forms` names them, so that the sets of the table stay the same."""


def one_row(
    what: str, number: int, seed: int, robots: str = "any", forms: tuple[str, ...] = (), least: float = LAMBDA[0]
) -> dict:
    """Return a set's row; a diagnosis that fails is a row that says so."""
    drawn = {"forms": [FORMS[name] for name in forms], "strength": (least, LAMBDA[1])} if forms else {}
    one = draw_set(what, number, seed=seed, robots=robots, **drawn)
    try:
        return row_of(one) | {"fault": ""}
    except Exception as fault:
        traceback.print_exc()
        return about(one) | {"claims": 0, "detected": False, "fault": f"{type(fault).__name__}: {fault}"[:200]}


def one_of(item: tuple) -> dict:
    return one_row(*item)


def main(
    kinds: list[str],
    sets: int,
    seed: int,
    jobs: int,
    cluster: str | None,
    out_dir: Path,
    *,
    robots: str = "any",
    forms: tuple[str, ...] = (),
    least: float = LAMBDA[0],
) -> None:
    out_dir.mkdir(parents=True, exist_ok=True)
    path = out_dir / "hidden_effects.csv"
    table = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=["what", "number"])
    if "seed" in table and (table["seed"].dropna() != seed).any():
        raise SystemExit(f"{path} holds sets of seed {table['seed'].iloc[0]:.0f}; name another folder with --out")
    for what in kinds:
        done = set(table.loc[table["what"] == what, "number"])
        chosen = (robots, forms, least) if forms or robots != "any" else ()
        items = [(what, number, seed, *chosen) for number in range(sets) if number not in done]
        for row in run_many(one_of, items, cluster=cluster, jobs=min(jobs, max(1, len(items)))):
            table = pd.concat([table, pd.DataFrame([row | {"seed": seed}])], ignore_index=True)
            write_whole(path, table.to_csv(index=False, float_format="%.6g"))  # a kill leaves the table before this row
            print(what, row["number"], row["names"], row["lambda"], "->", row.get("all"), row.get("unexplained"),
                  row["fault"], flush=True)  # fmt: skip
    table = pd.read_csv(path) if path.exists() else table  # as a later call reads it
    text = "\n".join(sentences(table))
    print(text)
    write_whole(out_dir / "hidden_effects.txt", text + "\n")
    write_whole(out_dir / "confusion.csv", confusion(table).to_csv())
    if (table["what"] == "single").any():
        power_curve(table, out_dir / "hidden_effects.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("--sets", type=int, default=300, help="sets of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    parser.add_argument(
        "--cluster", metavar="tcp://HOST:PORT", help="a Dask scheduler whose workers can import this file"
    )
    parser.add_argument("--robots", choices=sorted(DRAWS), default="any", help="robots of clean sets")
    parser.add_argument("--forms", nargs="+", choices=sorted(FORMS), default=[], metavar="FORM", help="only these hide")
    parser.add_argument("--least", type=float, default=LAMBDA[0], metavar="LAMBDA", help="weakest that --forms hide")
    args = parser.parse_args()
    import hidden_effects  # under its own name, so that other processes find its functions

    hidden_effects.main(
        args.what,
        args.sets,
        args.seed,
        args.jobs,
        args.cluster,
        args.out,
        robots=args.robots,
        forms=tuple(args.forms),
        least=args.least,
    )
