"""Spatial look-up: nearest segments and road edges."""
