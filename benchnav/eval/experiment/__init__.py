"""Experiments: suites, their conditions, units of work and hypotheses."""
