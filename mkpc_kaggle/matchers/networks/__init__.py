"""Networks written from their papers: PyTorch modules that load the public checkpoints unchanged."""
