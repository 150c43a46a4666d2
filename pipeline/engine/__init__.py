"""The engine: keys, plans, manifests, locks, atomic writes and resumable runs of stages."""
