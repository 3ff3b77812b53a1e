"""The central learner: PPO for both players, Alice behavioural cloning for Bob."""
