"""Kinematics of chapter 4 of Dressler 2012."""
