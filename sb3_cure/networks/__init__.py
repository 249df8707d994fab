"""Networks: encoders, decoders, layers, fast kernels, augmentations and numerical precision."""
