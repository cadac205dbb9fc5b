"""Figures of a run: one file a figure, drawn for the column of a paper."""
