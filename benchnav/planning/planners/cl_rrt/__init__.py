"""Closed-loop rapidly-exploring random trees (CL-RRT)."""
