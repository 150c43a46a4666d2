"""Weights and a first second to a played future."""
