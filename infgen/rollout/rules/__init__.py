"""Optional rules over the network's choices; ``rule_set`` says which are on."""
