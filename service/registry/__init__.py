"""The registry of frozen primitives: blobs, versions, aliases."""
