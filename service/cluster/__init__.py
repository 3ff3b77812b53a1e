"""Ray: self-play on a cluster, what keeps its workers going, and runs of a study as tasks."""
