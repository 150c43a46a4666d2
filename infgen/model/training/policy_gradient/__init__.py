"""Policy-gradient fine-tuning: rollouts of the network, their rewards, what is learned."""
