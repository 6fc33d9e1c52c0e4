"""The cache: least recently used goes first, and never more bytes than the limit."""

from hypothesis import given
from hypothesis import strategies as st

from mkpc_kaggle.data.images import ByteCache

KEYS = "abcde"


@given(
    st.integers(0, 20),
    st.lists(st.tuples(st.sampled_from(KEYS), st.one_of(st.none(), st.integers(0, 25))), max_size=40),
)
def test_it_agrees_with_a_plain_list_in_order_of_use(limit, steps):
    """A step puts a value of that size, or with no size asks for the key."""
    cache: ByteCache[str, int] = ByteCache(limit)
    used: list[tuple[str, int]] = []
    for key, size in steps:
        entry = next((entry for entry in used if entry[0] == key), None)
        if size is None:
            assert cache.get(key) == (entry[1] if entry else None)
        else:
            cache.put(key, size, size)
            entry = (key, size) if size <= limit else None
        used = [other for other in used if other[0] != key] + ([entry] if entry else [])
        while sum(size for _, size in used) > limit:
            used.pop(0)
        assert cache.bytes == sum(size for _, size in used)
