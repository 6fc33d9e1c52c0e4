"""The run engine: budget, store, schedule, loop and workers."""
