"""Closed-loop rapidly-exploring random trees."""
