"""Stage ``score``: rollouts to scores."""
