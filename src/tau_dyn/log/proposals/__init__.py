"""Proposed column maps: of one log, and of a folder of logs."""
