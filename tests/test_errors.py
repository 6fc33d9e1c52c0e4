"""Texts for users."""

from mkpc_kaggle.errors import plural


def test_counts_are_in_the_singular_and_the_plural():
    assert [plural(count, "batch") for count in (0, 1, 2)] == ["0 batches", "1 batch", "2 batches"]
    assert plural(1, "match") == "1 match"
    assert plural(2, "pair") == "2 pairs"
