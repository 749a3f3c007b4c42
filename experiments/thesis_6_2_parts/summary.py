"""Every number of the study beside the thesis' (empty where the thesis has none)."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from thesis_6_2_parts.friction import FrictionStudy
from thesis_6_2_parts.gravity import GravityStudy, most_symmetric
from thesis_6_2_parts.masses import PLATE, Asymmetry, TwoMasses
from thesis_6_2_parts.models import CircleStudy, ModelStudy
from thesis_6_2_parts.printed import CARTS, GRAVITY_MASS, SYMBOLS, TABLE_6_1, TABLE_6_2, TABLE_6_3, G

Row = tuple[str, str, float, float, str]


def tables(
    weight: GravityStudy, strokes: FrictionStudy, fits: ModelStudy, rods: pd.DataFrame
) -> dict[str, pd.DataFrame]:
    """Return the tables by file name."""
    rows = [
        {"position": s, "y_m": y, "z_m": z, "cart": j, "ours_N": ours, "thesis_N": theirs}
        for s, (y, z), forces, printed in zip(SYMBOLS, weight.fitted, weight.forces, TABLE_6_2, strict=True)
        for j, ours, theirs in zip(CARTS, forces, printed, strict=True)
    ]
    return {
        "table_6_1": strokes.table_6_1,
        "table_6_2": pd.DataFrame(rows),
        "table_6_2_by_mass": weight.profile,
        "table_6_3": fits.table,
        "figure_6_4": strokes.forces,
        "link_masses": rods,
    }


def summary(
    weight: GravityStudy,
    strokes: FrictionStudy,
    fits: ModelStudy,
    circles: dict[float, CircleStudy],
    two: TwoMasses,
    freed: dict[str, Asymmetry],
    rods: pd.DataFrame,
) -> pd.DataFrame:
    """Return what, ours, the thesis' and the unit, one row a number."""
    rows = [
        *_gravity(weight),
        *_friction(strokes),
        *_two_masses(two, fits),
        *_models(fits),
        *_freed(freed),
        *_rods(rods),
    ]
    table = pd.DataFrame([*rows, *_circles(circles)], columns=["part", "what", "ours", "thesis", "unit"])
    table["ours"] = table["ours"].where(table["ours"].abs() > 1e-6, 0.0)
    return table.dropna(subset=["ours", "thesis"], how="all")


def _gravity(weight: GravityStudy) -> Iterator[Row]:
    for s, (y, z), rms, (low, high) in zip(SYMBOLS, weight.fitted, weight.misfit, weight.intervals, strict=True):
        yield "Table 6.2", f"{s}: fitted y", y, np.nan, "m"
        yield "Table 6.2", f"{s}: fitted z", z, np.nan, "m"
        yield "Table 6.2", f"{s}: misfit at 22.38 kg", rms, np.nan, "N rms"
        yield "Table 6.2", f"{s}: smallest mass that fits", low, GRAVITY_MASS, "kg"
        yield "Table 6.2", f"{s}: largest mass that fits", high, GRAVITY_MASS, "kg"
    for mass in (9.13, 11.5, GRAVITY_MASS, weight.best_mass):
        yield "Table 6.2", f"misfit of all rows at {mass:g} kg", weight.rms_at(mass), np.nan, "N rms"
    for mass in (9.13, 11.5, GRAVITY_MASS):
        largest = G * mass * weight.largest_lever
        yield "Table 6.2", f"largest force of cart 3 in the frame at {mass:g} kg", largest, TABLE_6_2[:, 2].max(), "N"
    for k, j in enumerate(CARTS):
        yield (
            "Table 6.2",
            f"{j} in the frame's middle at 22.38 kg (thesis: star)",
            weight.centre[k],
            TABLE_6_2[0, k],
            "N",
        )
        shift = G * (GRAVITY_MASS - 11.5) * (weight.levers[3, k] - weight.levers[0, k])
        yield "Figure 6.4", f"{j}: the diamond would be off if gravity felt 11.5 kg", shift, np.nan, "N"
    offset = (TABLE_6_1["coulomb_pos"] - TABLE_6_1["coulomb_neg"]) / 2
    for name, (low, high) in most_symmetric(offset, TABLE_6_2[0]).items():
        yield "Table 6.1", f"most symmetric mass, least {name}, from", low, GRAVITY_MASS, "kg"
        yield "Table 6.1", f"most symmetric mass, least {name}, to", high, GRAVITY_MASS, "kg"


def _friction(strokes: FrictionStudy) -> Iterator[Row]:
    for row in strokes.table_6_1.itertuples():
        yield "Table 6.1", row.parameter, row.ours, row.thesis, row.unit
    alone = np.inf if strokes.free_at_star is None else strokes.free_at_star
    yield "Table 6.1", "standard error of the gravity mass, star alone, friction free", alone, np.nan, "kg"
    yield "Table 6.1", "gravity mass from five positions, friction free", strokes.free_everywhere[0], GRAVITY_MASS, "kg"
    yield "Table 6.1", "its standard error", strokes.free_everywhere[1], np.nan, "kg"


def _two_masses(two: TwoMasses, fits: ModelStudy) -> Iterator[Row]:
    yield "two masses", "truth: gravity 22.38, inertia 9.13; one plate mass, symmetric", two.one_column[0], 9.13, "kg"
    yield "two masses", "two columns, rods known: plate from inertia", two.inertia[0], 9.13, "kg"
    yield "two masses", "its standard error", two.inertia[1], np.nan, "kg"
    yield "two masses", "two columns, rods known: felt by gravity", two.gravity[0], GRAVITY_MASS, "kg"
    yield "two masses", "its standard error", two.gravity[1], np.nan, "kg"
    for name, ratio in two.energy.items():
        yield "two masses", f"plate column: gravity's energy over inertia's, {name}", ratio, np.nan, ""
    yield "two masses", "model 2, rods kept at 4.8 kg: plate", fits.known_rods, np.nan, "kg"


def _models(fits: ModelStudy) -> Iterator[Row]:
    for number in TABLE_6_3:
        rows = fits.table[fits.table["model"] == number]
        yield (
            "Table 6.3",
            f"model {number}: plate (rods left out)",
            rows["plate_kg"].iloc[0],
            rows["plate_thesis"].iloc[0],
            "kg",
        )
        for row in rows.itertuples():
            yield "Table 6.3", f"model {number}: {row.cart} mass", row.cart_kg, row.cart_thesis, "kg"
            yield "Table 6.3", f"model {number}: {row.cart} coulomb", row.coulomb_N, row.coulomb_thesis, "N"
            yield (
                "Table 6.3",
                f"model {number}: {row.cart} viscous",
                row.viscous_Ns_per_m,
                row.viscous_thesis,
                "N/(m/s)",
            )
            yield "Table 6.3", f"model {number}: {row.cart} e ratio, 5 N noise", row.e_ratio, row.e_ratio_thesis, ""
            yield (
                "Table 6.3",
                f"model {number}: {row.cart} e ratio, 50 N floor",
                row.e_ratio_floor,
                row.e_ratio_thesis,
                "",
            )


def _freed(freed: dict[str, Asymmetry]) -> Iterator[Row]:
    for motion, one in freed.items():
        part = f"asymmetric, {motion}"
        yield part, "plate, plain least squares", one.plain[PLATE], np.nan, "kg"
        yield part, "its standard error", one.stderr, np.nan, "kg"
        yield part, "plate, within physics", one.held[PLATE], np.nan, "kg"
        yield part, "plate, symmetric friction", one.symmetric_plate, np.nan, "kg"
        for k, j in enumerate(CARTS):
            yield part, f"correlation of plate and {j}'s offset", one.correlation[k], np.nan, ""
            for side in ("neg", "pos"):
                yield part, f"{j}.coulomb_{side}, plain", one.plain[f"{j}.coulomb_{side}"], np.nan, "N"


def _rods(rods: pd.DataFrame) -> Iterator[Row]:
    for row in rods.to_dict("records"):
        yield "link masses", f"{row['case']}: logs with a negative rod", row["any_negative_percent"], np.nan, "%"
        for k in (1, 2, 3):
            name = f"rod{k}_link.mass"
            what = f"{row['case']}: rod {k} mean, true {row[f'{name}_truth']}"
            yield "link masses", what, row[f"{name}_mean"], np.nan, "kg"
            yield "link masses", f"{row['case']}: rod {k} standard deviation", row[f"{name}_sd"], np.nan, "kg"


def _circles(circles: dict[float, CircleStudy]) -> Iterator[Row]:
    for share, one in circles.items():
        for k, j in enumerate(CARTS):
            yield "circle", f"Stribeck {100 * share:.0f} %: {j} misfit of model 2", one.misfit[k], np.nan, "N rms"
            yield (
                "circle",
                f"Stribeck {100 * share:.0f} %: {j} sign changes of the noisy speed",
                one.flips[k],
                np.nan,
                "",
            )
            yield (
                "circle",
                f"Stribeck {100 * share:.0f} %: {j} largest speed",
                1e3 * np.abs(one.speed[:, k]).max(),
                np.nan,
                "mm/s",
            )
