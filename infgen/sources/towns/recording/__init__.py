"""What the recording car of a town sees, as a scene."""
