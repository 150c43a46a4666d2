"""The network: from scene tokens to probabilities of the next ones."""
