"""The task generator: goal validity, difficulty, goal and opponent choice, and the stop criterion."""
