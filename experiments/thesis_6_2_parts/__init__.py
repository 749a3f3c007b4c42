"""The parts of `experiments/thesis_6_2.py`: section 6.2 of Dressler 2012 on the simulated L1."""
