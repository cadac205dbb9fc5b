"""Networks that tell of each cell its class, or its traversability at once."""
