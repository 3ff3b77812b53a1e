"""What every package uses: errors, types, atomic files, locks, JSON lines, tensors, progress, optional packages."""
