"""The registry of frozen primitives: versions, aliases, loading, publishing, and what comes with the package."""
