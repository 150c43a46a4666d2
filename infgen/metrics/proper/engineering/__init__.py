"""What traffic engineers judge traffic by, as values of logs and of rollouts."""
