"""Frozen policies on robots: what a back-end must offer, the control loop, and the safety that no policy can pass."""
