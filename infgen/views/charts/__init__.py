"""Charts of measured values."""
