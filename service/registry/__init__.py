"""Checkpoints of runs, and the registry of frozen primitives: blobs, versions, aliases."""
