"""Learning: the loss terms, their weights, closed-loop fine-tuning and diagnostics."""
