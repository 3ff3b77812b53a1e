"""What every room uses: errors, types, atomic files, locks, JSON lines, tensors, progress, optional packages."""
