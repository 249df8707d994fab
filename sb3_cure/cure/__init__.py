"""The method: the algorithm, its policy, critics, mixer and encoder update (Algorithm 1 of the paper)."""
