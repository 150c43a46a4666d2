"""Raw records and scene files: which there are, what they are, and their scenes."""
