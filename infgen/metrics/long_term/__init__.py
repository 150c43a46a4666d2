"""The long-term metrics of the InfGen paper."""
