"""How real a simulation is: features of traffic, their likelihoods, and scores.

``wosac`` scores short futures as the Waymo Open Sim Agents Challenge does, ``long_term``
scores long ones as the paper does; both stand on the same features.
"""
