"""The run engine: budget, journal, jobs and workers."""
