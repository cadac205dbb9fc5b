"""What planners are held to: the contract, and the boundary between a planner and an episode."""
