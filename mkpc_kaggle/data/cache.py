"""A least-recently-used cache with a limit in bytes, safe to share between threads."""

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class ByteCache(Generic[Key, Value]):
    """Keeps the most recently used values, ``limit`` bytes at most; a larger value is not kept."""

    def __init__(self, limit: int) -> None:
        self.limit, self.bytes = limit, 0
        self._entries: OrderedDict[Key, tuple[Value, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key) -> Value | None:
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def put(self, key: Key, value: Value, size: int) -> None:
        with self._lock:
            self.bytes += size - self._entries.pop(key, (value, 0))[1]
            self._entries[key] = value, size
            if size > self.limit:
                self.bytes -= self._entries.pop(key)[1]
            while self.bytes > self.limit:
                self.bytes -= self._entries.popitem(last=False)[1][1]
