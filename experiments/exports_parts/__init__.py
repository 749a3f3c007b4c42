"""The parts of `experiments/exports.py`: exported files in the programs that they are for."""
