"""The world: the effect of traversability on robots, and the ends of episodes."""
