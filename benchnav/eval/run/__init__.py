"""Running trials: episodes, units of work, run folders and their provenance."""
