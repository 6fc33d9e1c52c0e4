"""The matchers: one contract, one registry, and what adapters share."""
