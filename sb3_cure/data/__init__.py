"""Data: what a batch holds, replay buffers, observations and datasets."""
