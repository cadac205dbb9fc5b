"""Playback of episodes: files for the Rerun viewer, serving the viewer, and videos."""
