"""Learning new tasks with frozen primitives: the wrapper that composes them. Importing this package is cheap."""
