"""The same network with fewer launches, for training on a GPU."""
