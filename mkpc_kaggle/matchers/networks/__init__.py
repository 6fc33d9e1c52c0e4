"""Networks written from their papers: plain PyTorch modules that load the public checkpoints
unchanged.
"""
