"""Live reports of runs: written by runners to disk and to Redis, read by the status service."""
