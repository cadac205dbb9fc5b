"""The run folder: its tables, its steps, where its rows come from, and which share of a
run it holds.
"""
