"""Policies for use elsewhere: one folder with networks, what their numbers mean, and a README."""
