"""Mutants of the core rooms: where code may be broken on purpose, and what the tests say."""
