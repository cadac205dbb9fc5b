"""What robots learn on their way: what they sense, and what a belief makes of it."""
