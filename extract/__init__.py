"""Video to 6D object trajectory. Knows nothing of robots."""
