"""The page of `infgen drive`; it draws with the scripts of the player."""
