"""Plots of a run: its curves, its goals, and the coverage of random compositions of its primitives.

matplotlib is loaded by the first call, not by the import.
"""

from service.media.plots.coverage import plot_coverage
from service.media.plots.curves import plot_curves
from service.media.plots.goals import plot_goals

__all__ = ["plot_coverage", "plot_curves", "plot_goals"]
