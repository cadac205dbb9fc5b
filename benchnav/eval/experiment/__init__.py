"""What is asked: suites, their conditions, units of work and hypotheses."""
