"""How fast it is and compared with what, and what makes ``docs/results``; ``--help`` tells a script's options."""
