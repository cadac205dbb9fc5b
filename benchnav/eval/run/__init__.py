"""Running a suite in one or several processes, and merging or repeating runs."""
