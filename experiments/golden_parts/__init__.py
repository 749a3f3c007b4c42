"""Answers that must not drift, one function a study."""
