"""The assembly of a run: recipe, weights, device, matchers."""
