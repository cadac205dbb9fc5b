"""Statistics of comparisons: differences, intervals, tests, the best set, tables."""
