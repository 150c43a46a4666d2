"""Insertion: whether an agent is inserted, in which cell, and its details."""
