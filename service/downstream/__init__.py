"""New tasks with frozen primitives: composing them, SAC workers, the table. Importing this package is cheap."""
