"""Stages, shards and workers. Knows nothing of traffic."""
