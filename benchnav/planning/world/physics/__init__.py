"""Rigid bodies on soil: settings, laws, and the simulation with MuJoCo.

Importing this package does not import MuJoCo, the optional dependency `physics`.
"""
