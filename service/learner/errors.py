"""What can go wrong in the learner by the user's doing."""

from __future__ import annotations

from service.errors import TandemError


class LearnerError(TandemError):
    """A device that is not there, or a state that does not fit; the message says what to do."""
