"""The command ``sb3-cure``: training and tuning with rl-zoo3, watching, filming, experiments, and the doctor."""
