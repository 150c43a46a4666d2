"""The stages, from raw records to a report."""
