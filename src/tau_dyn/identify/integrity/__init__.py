"""Agreement of a log with the robot file: wiring, units and time of its columns, judged before a fit."""
