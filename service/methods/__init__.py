"""What a run can train: self-play, skill discovery, distillation and tasks; each is a ``Method``."""
