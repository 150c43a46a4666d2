"""Insertion of agents where the network is, without the host waiting for each of them."""
