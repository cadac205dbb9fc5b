"""Digests of results that a change of structure must not move."""
