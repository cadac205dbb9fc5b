"""The run folder: tables, steps, provenance, and shard."""
