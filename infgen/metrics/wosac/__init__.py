"""The metric of the Waymo Open Sim Agents Challenge, without TensorFlow."""
