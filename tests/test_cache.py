"""The cache: least recently used goes first, and never more bytes than the limit."""

from hypothesis import given
from hypothesis import strategies as st

from mkpc_kaggle.data.cache import ByteCache

KEYS = "abcde"


def filled(limit, **sizes):
    cache = ByteCache(limit)
    for key, size in sizes.items():
        cache.put(key, key.upper(), size)
    return cache


def kept(cache, keys=KEYS):
    return [key for key in keys if cache.get(key) is not None]


def test_a_value_comes_back_and_an_unknown_key_gives_none():
    cache = filled(10, a=3)
    assert cache.get("a") == "A"
    assert cache.get("b") is None


def test_the_value_put_first_goes_first():
    assert kept(filled(10, a=5, b=5, c=1)) == ["b", "c"]


def test_what_was_asked_for_stays_longer_than_what_was_not():
    cache = filled(10, a=5, b=5)
    cache.get("a")
    cache.put("c", "C", 5)
    assert kept(cache) == ["a", "c"]


def test_one_big_value_pushes_out_as_many_as_it_needs():
    cache = filled(10, a=3, b=3, c=3, d=7)
    assert kept(cache) == ["c", "d"]
    assert (len(cache), cache.bytes) == (2, 10)


def test_a_value_exactly_as_large_as_the_limit_is_kept():
    assert kept(filled(10, a=10)) == ["a"]


def test_a_value_above_the_limit_is_not_kept_and_pushes_nothing_out():
    cache = filled(10, a=4, b=11)
    assert kept(cache) == ["a"]
    assert cache.bytes == 4


def test_replacing_a_value_counts_its_bytes_once():
    cache = filled(10, a=8)
    cache.put("a", "new", 2)
    cache.put("b", "B", 8)
    assert cache.get("a") == "new"
    assert cache.bytes == 10


def test_replacing_a_value_by_one_above_the_limit_forgets_the_old_one():
    cache = filled(10, a=8)
    cache.put("a", "huge", 11)
    assert cache.get("a") is None
    assert (len(cache), cache.bytes) == (0, 0)


@given(
    st.integers(0, 20),
    st.lists(st.tuples(st.sampled_from(KEYS), st.one_of(st.none(), st.integers(0, 25))), max_size=40),
)
def test_it_agrees_with_a_plain_list_in_order_of_use(limit, steps):
    """A step puts a value of that size, or with no size asks for the key."""
    cache: ByteCache[str, int] = ByteCache(limit)
    used: list[tuple[str, int]] = []
    for key, size in steps:
        entry = next((one for one in used if one[0] == key), None)
        if size is None:
            assert cache.get(key) == (entry[1] if entry else None)
        else:
            cache.put(key, size, size)
            entry = (key, size) if size <= limit else None
        used = [one for one in used if one[0] != key] + ([entry] if entry else [])
        while sum(size for _, size in used) > limit:
            used.pop(0)
        assert (len(cache), cache.bytes) == (len(used), sum(size for _, size in used))
