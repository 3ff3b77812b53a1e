"""Tandem: asymmetric self-play that pre-trains reusable robot-manipulation skills.

Importing this package is cheap: torch, MuJoCo and matplotlib come in with the rooms that need them.
"""

__version__ = "0.1.0"
