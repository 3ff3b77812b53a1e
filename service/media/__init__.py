"""Recorded rounds and episodes, their videos, and the plots of a run."""
