"""Springs of a robot from vibration records at several poses."""

from .fit import find_springs as find_springs
from .result import FittedSpring as FittedSpring, RecordFit as RecordFit, SpringFit as SpringFit
