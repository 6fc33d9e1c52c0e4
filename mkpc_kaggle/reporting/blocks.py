"""What a page is made of: titled sections of texts, tables, plots and pictures. The template writes them."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

MOST_ROWS = 100


@dataclass(frozen=True)
class Text:
    """A paragraph; ``dim`` where it is a remark."""

    kind: ClassVar = "text"
    text: str
    dim: bool = False


@dataclass(frozen=True)
class Table:
    """Rows as long as ``heads``; columns of numbers stand to the right."""

    kind: ClassVar = "table"
    heads: Sequence[str]
    rows: Sequence[Sequence[object]]

    @property
    def numeric(self) -> list[bool]:
        """Which columns hold nothing but numbers."""
        columns = range(len(self.heads))
        return [bool(self.rows) and all(_is_number(row[column]) for row in self.rows) for column in columns]


@dataclass(frozen=True)
class Plot:
    """An ``<svg>`` element."""

    kind: ClassVar = "plot"
    svg: str


@dataclass(frozen=True)
class Picture:
    """A JPEG with its caption, and what it shows for those who cannot see it."""

    jpeg: bytes
    caption: str
    alternative: str

    @property
    def base64(self) -> str:
        return base64.b64encode(self.jpeg).decode()


@dataclass(frozen=True)
class Pictures:
    """Pictures beside each other."""

    kind: ClassVar = "pictures"
    pictures: Sequence[Picture]


Block = Text | Table | Plot | Pictures


@dataclass(frozen=True)
class Section:
    """A part of the page under a title of its own."""

    title: str
    blocks: Sequence[Block]


def first_rows(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> list[Block]:
    """A table of the first rows, and how many there are besides."""
    blocks: list[Block] = [Table(heads, rows[:MOST_ROWS])]
    if len(rows) > MOST_ROWS:
        blocks.append(Text(f"... and {len(rows) - MOST_ROWS} more; the journal command exports all.", dim=True))
    return blocks


def _is_number(value: object) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True
