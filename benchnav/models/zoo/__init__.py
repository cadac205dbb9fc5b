"""The field's ways to predict uncertainty, as trainable models: a file each, on one
network.
"""
