"""Files: atomic writes, locks, json lines, tensors, checkpoints, run directories."""
