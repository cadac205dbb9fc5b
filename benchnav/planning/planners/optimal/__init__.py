"""The optimal planner: value iteration over where a unicycle stands and looks."""
