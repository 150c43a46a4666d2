"""The traffic of a town: demand, simulation and smooth motion."""
