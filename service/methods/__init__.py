"""What a run can train: self-play, skill discovery, distillation; each is a ``Method``."""
