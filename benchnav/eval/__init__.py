"""Evaluation suites: rollouts, metrics, reports and playback (paper, IV)."""
