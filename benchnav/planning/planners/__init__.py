"""Planners: the protocol they share, and the shipped ones."""
