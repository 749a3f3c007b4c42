"""Mass, damping and stiffness behind a black-box model."""

from .mass_damping_stiffness import Mechanical as Mechanical, fit_mechanical as fit_mechanical
from .structure import SecondOrder as SecondOrder
