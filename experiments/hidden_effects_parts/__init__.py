"""The parts of `experiments/hidden_effects.py`: logs with something hidden in them, made without `diagnose`'s own effects."""
