"""Soft actor-critic on many worlds: replay with hindsight, networks, updates. It knows no task and no runner."""
