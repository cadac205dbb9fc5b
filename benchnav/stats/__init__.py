"""Statistics of comparisons: paired differences, intervals, tests, the best set, and
their tables.
"""
