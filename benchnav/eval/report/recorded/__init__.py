"""What was recorded of an episode, as figures and playback read it."""
