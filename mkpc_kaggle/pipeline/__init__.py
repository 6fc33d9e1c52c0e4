"""The two matching stages, on a minibatch of pairs or on one pair."""
