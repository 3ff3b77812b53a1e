"""The learners: PPO for both players with Alice behavioural cloning for Bob, and soft actor-critic on many worlds."""
