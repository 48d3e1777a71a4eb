"""How large things usually are: a table of household objects, and finding a word in it.

`sizes.csv` beside this file is the table of this package: over a thousand phrases with the typical largest full extent
in metres, the range most such things lie in, and other words for the same thing. Tables of others are read as well:
CSV with the same columns, or JSON that maps phrases to metres, as FreePose's tables made by language models do.
"""

from __future__ import annotations

import csv
import difflib
import functools
import json
import logging
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import UserError
from .geometry import Array

OWN_TABLE = Path(__file__).with_name("sizes.csv")
COLUMNS = ("phrase", "typical_m", "low_m", "high_m", "also")
MAX_TABLE_BYTES = 16 * 1024 * 1024
IRREGULAR = {"knives": "knife", "loaves": "loaf", "leaves": "leaf", "shelves": "shelf", "mice": "mouse", "dies": "die"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SizeEntry:
    """One kind of object.

    typical_m: largest full extent [m].  low_m, high_m: where most such things lie; both equal typical_m where a table
    gives no range.  also: other words for it.
    """

    phrase: str
    typical_m: float
    low_m: float
    high_m: float
    also: tuple[str, ...] = ()

    def holds(self, size_m: float) -> bool:
        """Whether a largest extent [m] is a usual one for this kind of object."""
        return self.low_m <= size_m <= self.high_m


@dataclass(frozen=True)
class SizeTable:
    """Entries with distinct phrases; `name` says which table it is."""

    name: str
    entries: tuple[SizeEntry, ...]

    @property
    def phrases(self) -> tuple[str, ...]:
        return tuple(entry.phrase for entry in self.entries)

    @property
    def typical_m(self) -> Array:
        """(N,) typical largest full extents [m], in the order of `phrases`."""
        return np.array([entry.typical_m for entry in self.entries])

    @functools.cached_property
    def _by_words(self) -> Mapping[str, SizeEntry]:
        words = {normal(other): entry for entry in self.entries for other in entry.also}
        return words | {normal(entry.phrase): entry for entry in self.entries}  # a phrase of its own goes first

    def find(self, words: str) -> SizeEntry | None:
        """The entry that words name, or None.

        In this order: the words themselves; their last word in the singular; "X of Y" as "Y X", as "X" and as
        "Y" (a pair of scissors); each with leading words left out, so that a
        "red coffee mug" is a coffee mug.
        """
        text = normal(words)
        match = re.match(r"(.+?) (?:of|with|for|in|on|from) (.+)$", text)
        if not match:
            return self._by_tail(text)
        thing, other = match[1], match[2]
        return self._by_words.get(text) or next(
            filter(None, map(self._by_tail, (f"{other} {thing}", thing, other))), None
        )

    def _by_tail(self, text: str) -> SizeEntry | None:
        """The entry of the longest tail of the words that names one."""
        parts = text.split()
        for first in range(len(parts)):
            lead = parts[first:-1]
            for last in (parts[-1], *_singulars(parts[-1])):
                if entry := self._by_words.get(" ".join([*lead, last])):
                    return entry
        return None

    def look_up(self, words: str) -> SizeEntry:
        """The entry that words name. Raises UserError, naming what comes near, when there is none."""
        if entry := self.find(words):
            return entry
        known = list(self._by_words)
        text = normal(words)
        near = difflib.get_close_matches(text, known, 4, 0.7) if text else []
        if not near and text:
            near = difflib.get_close_matches(text.split()[-1], known, 4, 0.7)
        hint = (
            f"did you mean {', '.join(near)}?" if near else f"it knows {len(self.entries)} kinds, such as mug or bowl"
        )
        raise UserError(f"the size table {self.name} has no entry for {words!r}; {hint}")


def normal(words: str) -> str:
    """Words in the form they are compared in: lower case, single spaces, no hyphens, articles or "a photo of"."""
    text = re.sub(r"[\s_\-–,.;:!?\"]+", " ", words.lower().replace("’", "'")).strip()
    text = re.sub(r"^(?:(?:a|the)? ?(?:photo|picture|image) of )", "", text)
    return re.sub(r"^(?:(?:an?|the|my|your|some)(?: |$))+", "", text)


def prompt(phrase: str) -> str:
    """The sentence a text-image model is asked, "a photo of a mug"."""
    return f"a photo of {'an' if phrase[:1].lower() in 'aeiou' else 'a'} {phrase}"


@functools.cache
def own_table() -> SizeTable:
    """The table that ships with this package."""
    return load_size_table(OWN_TABLE)


def load_size_table(path: Path) -> SizeTable:
    """Read a table: CSV (columns phrase, typical_m, and if wanted low_m, high_m, also) or JSON {phrase: metres}.

    All sizes are largest full extents in metres. In JSON, phrases that differ only by case, spaces, article or "a
    photo of" become one with the median of their sizes, for tables made by language models have many; in CSV they are
    an error.  Raises UserError for a missing or damaged file, and for a size that is not a positive number.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"size table {path} does not exist")
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise UserError(f"size table {path} has more than {MAX_TABLE_BYTES // 2**20} MiB; it should be a list of words")
    readers = {".csv": _from_csv, ".json": _from_json}
    if path.suffix.lower() not in readers:
        raise UserError(f"size table {path} has the suffix {path.suffix!r}; a table is read from .csv or .json")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"size table {path} is not UTF-8 text; save it as UTF-8") from error
    entries = readers[path.suffix.lower()](text, path)
    if not entries:
        raise UserError(f"size table {path} holds no sizes")
    return SizeTable("vid2demo" if path == OWN_TABLE else path.name, entries)


def _from_csv(text: str, path: Path) -> tuple[SizeEntry, ...]:
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    rows = csv.reader(line for _, line in lines)
    header = tuple(name.strip() for name in next(rows, []))
    if header[:2] != COLUMNS[:2] or not set(header) <= set(COLUMNS):
        raise UserError(f"size table {path} begins with {','.join(header)!r}; its columns are {','.join(COLUMNS)}")
    entries: list[SizeEntry] = []
    seen: dict[str, int] = {}
    for (number, _), row in zip(lines[1:], rows, strict=True):
        where = f"line {number} of size table {path}"
        if len(row) != len(header):
            raise UserError(f"{where} has {len(row)} values for {len(header)} columns")
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        typical = _metres(cells["typical_m"], where)
        low, high = (_metres(cells.get(key) or typical, where) for key in ("low_m", "high_m"))
        if not low <= typical <= high:
            raise UserError(f"{where}: {typical:g} m lies outside its own range of {low:g} to {high:g} m")
        also = tuple(word.strip() for word in cells.get("also", "").split(";") if word.strip())
        for word in (cells["phrase"], *also):
            key = normal(word)
            if not key:
                raise UserError(f"{where} has no phrase")
            if key in seen:
                raise UserError(f"{where} names {word!r}, which line {seen[key]} has already; keep one of them")
            seen[key] = number
        entries.append(SizeEntry(cells["phrase"], typical, low, high, also))
    return tuple(entries)


def _from_json(text: str, path: Path) -> tuple[SizeEntry, ...]:
    try:
        pairs = json.loads(text, object_pairs_hook=lambda pairs: pairs)
    except json.JSONDecodeError as error:
        raise UserError(f"size table {path} is not JSON ({error})") from error
    if not isinstance(pairs, list) or not all(isinstance(pair, tuple) for pair in pairs):
        raise UserError(f"size table {path} must be one JSON object that maps phrases to metres")
    sizes: dict[str, list[float]] = {}
    for phrase, size in pairs:
        sizes.setdefault(normal(phrase), []).append(_metres(size, f"{phrase!r} in size table {path}"))
    if junk := sizes.pop("", None):
        _log.warning("%s: %d entries without a word left out", path, len(junk))
    if (extra := len(pairs) - len(sizes) - len(junk or [])) > 0:
        _log.warning("%s: %d phrases are there more than once; the median of their sizes is taken", path, extra)
    return tuple(SizeEntry(phrase, m := float(np.median(values)), m, m) for phrase, values in sizes.items())


def _metres(value: object, where: str) -> float:
    try:
        size = float(value) if isinstance(value, (str, int, float)) and not isinstance(value, bool) else math.nan
    except ValueError:
        size = math.nan
    if not (math.isfinite(size) and size > 0):
        raise UserError(f"{where}: {value!r} is not a size; give a positive number of metres")
    return size


def _singulars(word: str) -> Iterable[str]:
    """What a plural may be the plural of."""
    if word in IRREGULAR:
        yield IRREGULAR[word]
    if word.endswith("ies"):
        yield word[:-3] + "y"
    if word.endswith("es"):
        yield word[:-2]
    if word.endswith("s") and not word.endswith("ss"):
        yield word[:-1]
