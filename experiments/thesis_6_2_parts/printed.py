"""What section 6.2 of Dressler 2012 prints: Tables 6.1 to 6.3 and the two masses, in SI units."""

import numpy as np

G = 9.81  # m/s^2
CARTS = ("cart1", "cart2", "cart3")
GRAVITY_MASS = 22.38  # kg, plate and half the links, from the friction experiments
SYMBOLS = ("*", "square", "circle", "diamond", "+")
NAMES = dict(zip(SYMBOLS, ("star", "square", "circle", "diamond", "plus"), strict=True))

TABLE_6_1 = {  # N, N, N/(m/s), N/(m/s), carts 1 to 3
    "coulomb_neg": np.array([145.69, 119.23, 177.22]),
    "coulomb_pos": np.array([189.12, 262.59, 239.06]),
    "viscous_neg": np.array([158.01, 133.76, 197.52]),
    "viscous_pos": np.array([205.03, 190.00, 185.94]),
}
TABLE_6_2 = np.array(  # N, one row a position in the order of SYMBOLS, one column a cart
    [
        [-176.9, -14.6, 191.5],
        [-159.1, -23.7, 182.8],
        [-180.3, -3.6, 183.9],
        [-261.8, -21.5, 283.3],
        [-201.6, -33.7, 235.3],
    ]
)
NAN = np.full(3, np.nan)
TABLE_6_3 = {  # model: plate [kg], carts [kg], coulomb [N], viscous [N/(m/s)], e_i [1e7 N^2]
    1: (8.76, [14.33, 14.05, 38.10], [152.13, 259.09, 291.24], NAN, [1.11, 2.33, 1.98]),
    2: (9.13, [13.58, 13.64, 38.23], [128.62, 145.13, 194.57], [102.43, 355.25, 388.77], [1.03, 1.29, 1.05]),
    3: (8.79, [13.85, 14.85, 38.47], NAN, NAN, [2.38, 3.07, 1.77]),
    4: (9.67, [12.51, 12.73, 37.70], [109.97, 207.13, 243.75], NAN, [1.11, 1.60, 1.31]),
}
