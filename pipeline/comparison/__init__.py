"""Comparisons: several methods trained, simulated and scored alike."""
