"""Relative poses without features of their own: rotary embedding, and coordinates."""
