"""Experiments: what is trained, measured and drawn around the algorithm."""
