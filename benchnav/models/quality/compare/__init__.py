"""Compares several models on the same maps."""
