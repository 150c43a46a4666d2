"""Rollouts in the formats of others."""
