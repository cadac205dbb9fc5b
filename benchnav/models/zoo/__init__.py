"""Trainable models with the field's methods for predictive uncertainty: one per file, on
a common network.
"""
