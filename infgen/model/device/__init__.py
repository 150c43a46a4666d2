"""What training on a GPU does otherwise: fewer launches, copies and waits."""
