"""Batches: tokenized scenes as cropped and padded tensors."""
