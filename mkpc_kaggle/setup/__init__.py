"""Set-up of a run: checked arguments, available matchers and weights, devices, and their assembly."""
