"""The matchers: one contract, one registry, and shared parts of adapters."""
