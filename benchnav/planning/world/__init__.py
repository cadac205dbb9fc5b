"""The world: the effect of traversability on robots, and the outcomes of episodes."""
