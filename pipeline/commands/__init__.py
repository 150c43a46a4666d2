"""Commands that make no stage, and what commands print."""
