"""Files that outlive a process: model archives, replay buffers, checkpoints, the state of environments."""
