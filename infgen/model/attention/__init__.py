"""Attention over neighbours, a few targets at a time."""
