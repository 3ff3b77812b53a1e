"""What is known about runs while they go on: told by runners, kept on disk and in Redis, read by the status service."""
