"""Primitives: loading, publishing, and those that come with the package."""
