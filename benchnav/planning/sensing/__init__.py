"""Sensing and belief: measurements during an episode, and the λ that they imply."""
