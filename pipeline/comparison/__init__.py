"""Comparisons: several methods trained, simulated and scored alike, as in the paper's tables."""
