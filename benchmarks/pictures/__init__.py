"""The pictures of ``docs/results``, drawn from recorded runs alone."""
