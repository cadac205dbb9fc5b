"""Networks that predict the class or the traversability of each cell."""
