"""Scenes to tokens and back."""
