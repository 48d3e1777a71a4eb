"""Datasets and environments to trained and evaluated policies."""
