"""The two stages on a batch of pairs, and one pair at a time."""
