"""What a run leaves: its directory, checkpoints, records and status; on disk, and in Redis where one is configured."""
