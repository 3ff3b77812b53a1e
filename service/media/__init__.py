"""Pictures of a run: recorded rounds, videos, plots."""
