"""The parts of `experiments/comparison.py`: one file a data set in `sets`, one a tool in `tools`."""
