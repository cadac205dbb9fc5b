"""Runs of tests time a few steps of one robot alone, not a hundred; the tests of
latency time what runs time.
"""

from benchnav.eval.run import latency

MAX_STEPS = latency._MAX_STEPS
latency._MAX_STEPS = 3
