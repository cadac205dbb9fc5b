"""The world: what traversability does to a robot, and how an episode ends."""
