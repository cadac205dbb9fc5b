"""Reports of runs: findings, tables, pages, and playback of episodes."""
