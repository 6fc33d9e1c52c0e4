"""The matchers: one interface, one registry, one file each."""
