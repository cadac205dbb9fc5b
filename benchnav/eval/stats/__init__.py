"""Statistics of conditions."""
