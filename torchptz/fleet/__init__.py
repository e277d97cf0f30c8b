"""Many cameras: configuration, collection, solution."""
