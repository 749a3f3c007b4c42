"""The simulator of `servo_sets.py`."""
