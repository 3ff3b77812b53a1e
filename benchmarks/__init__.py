"""How fast it is, compared with what, and the records behind ``docs/results``; every script says its options with ``--help``."""
