"""What the package does on a GPU: numbers against the CPU, seconds, memory, and runs that go wrong."""
