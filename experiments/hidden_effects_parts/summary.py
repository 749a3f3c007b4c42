"""The study's table in numbers: what `diagnose` claims of clean logs, finds of hidden effects, and calls them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy import stats

CLASSES = ((15, 30), (30, 60), (60, 120), (120, 10_000))
"""Classes of lambda, as the requirement has them."""

HALF = 0.6745
"""Standard errors that half of all normal errors stay within."""

OPTIONAL = (
    "gain_ratio",
    "parameter_error",
    "parameter_z",
    "joint_right",
    "variables_right",
    "variables_among",
    "known_model",
    "fault",
)
"""Columns that only some rows have."""


def upper_bound(k: int, n: int, level: float = 0.95) -> float:
    """Return the exact one-sided upper bound of a rate seen k times in n (Clopper & Pearson 1934)."""
    return 1.0 if k >= n else float(stats.beta.ppf(level, k + 1, n - k))


def interval(k: int, n: int) -> tuple[float, float]:
    """Return the exact two-sided 95 % interval of a rate seen k times in n."""
    low = 0.0 if k == 0 else float(stats.beta.ppf(0.025, k, n - k + 1))
    return low, upper_bound(k, n, 0.975)


def limit(strength: np.ndarray, table: pd.DataFrame, dof: int = 1) -> np.ndarray:
    """Return the Neyman-Pearson limit: the power of one test on the true shape at the family-wise level."""
    level = float(table["family_level"].median()) / float(table["causes_tried"].median())
    return np.asarray(stats.ncx2.sf(stats.chi2.isf(level, dof), dof, np.maximum(strength, 1e-9)))


def sentences(table: pd.DataFrame) -> Iterator[str]:
    """Return the summary line by line."""
    table = table.reindex(columns=list(dict.fromkeys([*table.columns, *OPTIONAL])))
    faults = table["fault"].fillna("") != ""
    if faults.any():
        yield f"{int(faults.sum())} of {len(table)} diagnoses failed, such as: {table['fault'][faults].iloc[0]}"
    for what, rows in table.groupby("what", sort=False):
        match what:
            case "clean" | "feedback":
                yield from _clean(str(what), rows)
            case "single":
                yield from _single(rows)
            case "pairs":
                yield from _pairs(rows)
            case "unknown":
                yield from _unknown(rows)
        yield f"  time: median {rows['seconds'].median():.1f} s, longest {rows['seconds'].max():.1f} s"


def rate(flags: pd.Series) -> str:
    """Return a share with its interval."""
    k, n = int(flags.eq(True).sum()), len(flags)  # a diagnosis that failed has no flag and counts as none
    if not n:
        return "no set"
    low, high = interval(k, n)
    return f"{100 * k / n:5.1f} % ({k}/{n}; {100 * low:.1f} to {100 * high:.1f})"


def confusion(table: pd.DataFrame) -> pd.DataFrame:
    """Return how often each hidden form (rows) was first called what (columns)."""
    single = table[table["what"] == "single"]
    first, rest = (
        single[key].fillna("").astype(str) for key in ("first", "unexplained")
    )  # empty columns read as floats
    silent = np.where(rest.str.contains("confirmed"), "unexplained", "nothing")
    said = first.mask(first == "", pd.Series(silent, single.index))
    return pd.crosstab(single["names"], said)


def _clean(what: str, rows: pd.DataFrame) -> Iterator[str]:
    k, n = int((rows["claims"] > 0).sum()), len(rows)
    yield f"{what}: {k} of {n} sets with a claim, so below {100 * upper_bound(k, n):.2f} % (95 %)"
    for coarse, part in rows.groupby(rows["position_sd"] > rows["position_sd"].median()):
        yield f"  {'coarse' if coarse else 'fine'} encoders: {int((part['claims'] > 0).sum())} of {len(part)}"
    with_file = rows["known_model"].eq(True)
    known = rows[rows["nominal"].eq(True) | with_file]
    yield f"  bodies as the person's model has them: {_count_false_parameters(known)} of {len(known)} with a parameter finding"
    several = rows["motions"].astype(str).str.contains(";")
    groups = {"several logs": several, "one log": ~several, "a model file": with_file, "no model file": ~with_file}
    kinds = rows["robot"].astype(str).str.replace(r"^tree\d+$", "tree", regex=True)
    groups |= {str(kind): kinds == kind for kind in sorted(kinds.unique())}
    for name, chosen in groups.items():
        part = rows[chosen]
        unexplained = int(part["unexplained"].astype(str).str.contains(":confirmed").sum())
        yield (
            f"  {name}: {len(part)} sets, {int((part['claims'] > 0).sum())} with a claim "
            f"({unexplained} with confirmed unexplained structure), {_count_false_parameters(part)} with a false parameter"
        )


def _count_false_parameters(rows: pd.DataFrame) -> int:
    return int(rows["false_parameter"].eq(True).sum())


def _single(rows: pd.DataFrame) -> Iterator[str]:
    refit = rows[~rows["form"].isin(("Payload", "LinkMass"))]
    strength = refit["lambda"].astype(float)
    for low, high in CLASSES:
        part = refit[(strength >= low) & (strength < high)]
        best = 100 * limit(part["lambda"].astype(float).to_numpy(), rows).mean() if len(part) else np.nan
        name = f"lambda {low} to {high}" if high < 1000 else f"lambda from {low}"
        yield f"single, {name}: detected {rate(part['detected'])}, limit {best:.1f} %"
        yield f"  first name right {rate(part['first_right'])}; right or twin {rate(part['twin_right'])}"
    strong = refit[strength >= 120]
    yield f"single, gain over the oracle's: median {strong['gain_ratio'].median():.3f}"
    by_name = refit["first"] == refit["names"].str.split("/").str[0]  # a twin's parameters mean something else
    refit = refit.assign(parameter_z=refit["parameter_z"].where(by_name))
    known = refit[(strength >= 100) & by_name & refit["parameter_error"].notna()]
    least = HALF / np.sqrt(known["lambda"].astype(float).to_numpy())  # one amplitude, all else known
    yield (
        f"single, parameters at lambda 100 and more: median error {100 * known['parameter_error'].median():.1f} % "
        f"({len(known)} sets), of an oracle {100 * np.median(least):.1f} %"
    )
    z = refit["parameter_z"].dropna()
    yield f"  true value within two standard errors {rate(z.abs() < 2)}; median distance {z.abs().median():.2f} (0.67)"
    for form, part in refit[strength >= 60].groupby("form"):
        yield f"  {form}: detected {rate(part['detected'])}; right {rate(part['first_right'])}"
    heavy = rows[rows["form"].isin(("Payload", "LinkMass"))]
    if len(heavy):
        yield f"single, bodies off by 15 to 50 %: {rate(heavy['detected'])}; right {rate(heavy['first_right'])}"


def _pairs(rows: pd.DataFrame) -> Iterator[str]:
    yield f"pairs: both found {rate(rows['found'] == 2)}; a spurious third {rate(rows['spurious'] > 0)}"


def _unknown(rows: pd.DataFrame) -> Iterator[str]:
    strong = rows[rows["lambda"].astype(float) >= 60]
    yield f"unknown, lambda from 60: detected {rate(strong['detected'])}; a false name {rate(rows['first'].fillna('') != '')}"
    yield f"  joint right {rate(strong['joint_right'])}; variables right {rate(strong['variables_right'])}"
    yield f"  the very variables, or listed as explaining it as well {rate(strong['variables_among'])}"
