"""Change points within a log: hypotheses, white rows, and the step that fits best."""
