"""Networks written from their papers. They load the public checkpoints unchanged."""
