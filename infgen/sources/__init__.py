"""Where scenes come from: record bytes to ``Scene``, and back."""
