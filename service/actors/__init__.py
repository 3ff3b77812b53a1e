"""Rounds of self-play on a batch of worlds, their rollouts, evaluation and coverage. No torch in here."""
