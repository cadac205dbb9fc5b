"""Training: data, the loop, and what is there already."""
