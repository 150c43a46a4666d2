"""What is to be avoided in rollouts, of all choices of the vocabulary."""
