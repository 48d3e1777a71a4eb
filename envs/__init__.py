"""6D object trajectory to a Gymnasium environment with a reference-tracking reward."""
