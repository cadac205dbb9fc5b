"""The optimal planner: value iteration over the poses of a unicycle."""
