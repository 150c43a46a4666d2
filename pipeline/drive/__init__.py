"""Driving the ego by hand in simulated traffic: `infgen drive`."""
