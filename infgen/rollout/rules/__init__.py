"""Optional rules over the choices of the network: collision, off-road, stalls, density."""
