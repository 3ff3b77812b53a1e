"""A run: one loop, one directory, one way to stop and to resume, for every method."""
