"""What puts the parts together into a run: the local runner, its directory, its pictures."""
