"""The summary of a run, its page, and figures."""
