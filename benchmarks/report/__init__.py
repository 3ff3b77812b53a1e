"""Pages and pictures of ``docs`` from the recorded files in ``docs/results``; see ``__main__``."""
