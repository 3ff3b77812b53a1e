"""Skill-discovery baselines: LSD, DIAYN, DADS and METRA on one off-policy loop, with the object's position as prior."""
