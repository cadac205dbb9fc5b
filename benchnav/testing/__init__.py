"""Checks for the tests of whoever writes a planner or a model."""
