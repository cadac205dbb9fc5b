"""Optimal planner: value iteration over the poses of a unicycle."""
