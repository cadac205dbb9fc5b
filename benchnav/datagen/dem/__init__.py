"""Import of real elevation models and photos into datasets of the same schema."""
