"""The matchers: one contract, one registry, one file each."""
