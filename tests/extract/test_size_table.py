from __future__ import annotations

import itertools
import json
import logging
import tomllib
from pathlib import Path

import pytest
from vid2demo.extract.errors import UserError
from vid2demo.extract.size_table import OWN_TABLE, SizeEntry, SizeTable, load_size_table, normal, own_table, prompt
from vid2demo.extract.vessels import CATEGORIES, make_vessel

# Measured things, largest extent in metres: most are of the YCB set, others from standards (paper, cards, balls).
MEASURED_M = {
    "cracker box": 0.210, "sugar box": 0.176, "tomato soup can": 0.102, "mustard bottle": 0.191, "tuna fish can": 0.085,
    "pudding box": 0.110, "gelatin box": 0.089, "potted meat can": 0.102, "banana": 0.178, "pitcher": 0.242,
    "bleach bottle": 0.250, "bowl": 0.159, "mug": 0.117, "power drill": 0.187, "wood block": 0.206, "scissors": 0.202,
    "large marker": 0.121, "foam brick": 0.078, "sheet of paper": 0.297, "cd": 0.12, "credit card": 0.0856,
    "tennis ball": 0.067, "golf ball": 0.0427, "soccer ball": 0.22, "basketball": 0.24, "soda can": 0.122,
    "wine bottle": 0.30, "aa battery": 0.0505, "vinyl record": 0.305, "toilet paper": 0.11, "door": 2.03,
}  # fmt: skip


def test_table_is_large_and_its_words_are_distinct() -> None:
    table = own_table()
    assert len(table.entries) >= 800
    words = [normal(word) for entry in table.entries for word in (entry.phrase, *entry.also)]
    assert len(words) == len(set(words))
    assert all(words)
    assert all(entry.phrase == entry.phrase.strip() == " ".join(entry.phrase.split()) for entry in table.entries)


def test_every_size_is_of_a_household_object_and_within_its_range() -> None:
    for entry in own_table().entries:
        assert 0.005 <= entry.low_m <= entry.typical_m <= entry.high_m <= 5.0, entry
        assert entry.low_m < entry.high_m, entry
        assert entry.typical_m / entry.low_m <= 8, entry  # an order of magnitude, not a guess at everything
        assert entry.high_m / entry.typical_m <= 20, entry


def test_typical_size_is_not_at_the_edge_of_its_range() -> None:
    assert not [e.phrase for e in own_table().entries if e.typical_m in (e.low_m, e.high_m)]


@pytest.mark.parametrize(("words", "size_m"), MEASURED_M.items())
def test_measured_things_lie_in_their_range(words: str, size_m: float) -> None:
    entry = own_table().look_up(words)
    assert entry.holds(size_m)
    assert 0.6 < entry.typical_m / size_m < 1.6


@pytest.mark.parametrize(
    "chain",
    [
        ("espresso cup", "mug", "jug", "bucket"),
        ("teaspoon", "tablespoon", "ladle", "broom"),
        ("grape", "plum", "apple", "melon", "watermelon"),
        ("table tennis ball", "tennis ball", "baseball", "soccer ball", "exercise ball"),
        ("stool", "chair", "wardrobe"),
        ("shot glass", "whiskey glass", "beer glass", "wine glass", "wine bottle"),
        ("needle", "pencil", "ruler", "baseball bat", "ski"),
    ],
)
def test_sizes_are_in_the_order_anybody_would_put_them(chain: tuple[str, ...]) -> None:
    sizes = [own_table().look_up(words).typical_m for words in chain]
    assert all(a < b for a, b in itertools.pairwise(sizes))


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_vessel_of_the_library_has_an_entry_that_fits_it(category: str) -> None:
    assert own_table().look_up(category).holds(max(make_vessel(category).extents_m))


@pytest.mark.parametrize(
    ("words", "phrase"),
    [
        ("mug", "mug"),
        ("  Coffee\tMUG ", "mug"),
        ("a photo of a mug", "mug"),
        ("my red ceramic mug", "mug"),
        ("mugs", "mug"),
        ("knives", "knife"),
        ("cherries", "cherry"),
        ("gooseneck_kettle", "gooseneck kettle"),
        ("box of cereal", "cereal box"),
        ("bowl of soup", "bowl of soup"),
        ("jar with a lid", "jar"),
        ("a pair of scissors", "scissors"),
        ("glasses", "eyeglasses"),
        ("glass", "drinking glass"),
        ("the blue flower vase", "vase"),
    ],
)
def test_words_find_their_entry(words: str, phrase: str) -> None:
    assert own_table().look_up(words).phrase == phrase


@pytest.mark.parametrize(
    ("words", "near"), [("muug", "mug"), ("green teapott", "teapot"), ("frobnicator", "such as mug")]
)
def test_unknown_words_name_what_comes_near(words: str, near: str) -> None:
    with pytest.raises(UserError, match=f"no entry for '{words}'.*{near}"):
        own_table().look_up(words)
    assert own_table().find(words) is None


@pytest.mark.parametrize("words", ["", "a", "the", " of ", "of mug of"])
def test_odd_words_do_no_harm(words: str) -> None:
    found = own_table().find(words)
    assert found is None or isinstance(found, SizeEntry)


def test_prompts_read_as_english() -> None:
    assert prompt("mug") == "a photo of a mug"
    assert prompt("egg cup") == "a photo of an egg cup"


def test_table_ships_with_the_package() -> None:
    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert OWN_TABLE.name in settings["tool"]["setuptools"]["package-data"]["vid2demo.extract"]


def test_tables_of_language_models_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "gpt.json"
    path.write_text(
        '{"a photo of a mug": 0.1, "a photo of a mug ": 0.2, "A photo of an egg": 0.06, "a": 3, "the Mug": 0.14}'
    )
    with caplog.at_level(logging.WARNING):
        table = load_size_table(path)
    assert table.phrases == ("mug", "egg")
    assert table.typical_m.tolist() == [pytest.approx(0.14), 0.06]
    assert table.look_up("mug").low_m == table.look_up("mug").high_m == pytest.approx(0.14)
    assert "2 phrases" in caplog.text
    assert "1 entries without a word" in caplog.text


def test_table_may_leave_out_ranges_and_other_words(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("# mine\nphrase,typical_m\nwidget,0.3\n\nred widget,0.2\n")
    table = load_size_table(tmp_path / "mine.csv")
    assert table.name == "mine.csv"
    assert table.look_up("big widget") == SizeEntry("widget", 0.3, 0.3, 0.3)
    assert table.look_up("red widgets").typical_m == 0.2


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("t.csv", "phrase,typical_m\nmug,big", "line 2 .*'big' is not a size"),
        ("t.csv", "phrase,typical_m\nmug,-1", "'-1' is not a size"),
        ("t.csv", "phrase,typical_m\nmug,nan", "is not a size"),
        ("t.csv", "phrase,typical_m,low_m,high_m\nmug,0.1,0.2,0.3", "outside its own range"),
        ("t.csv", "phrase,typical_m\nmug,0.1\n# x\nMUG,0.2", "line 4 .* which line 2 has"),
        ("t.csv", "phrase,typical_m\nmug,0.1,7", "3 values for 2 columns"),
        ("t.csv", "phrase,typical_m\n,0.1", "has no phrase"),
        ("t.csv", "name,size\nmug,0.1", "its columns are phrase,typical_m"),
        ("t.csv", "", "its columns are"),
        ("t.csv", "phrase,typical_m\n", "holds no sizes"),
        ("t.json", "{", "is not JSON"),
        ("t.json", "[1, 2]", "must be one JSON object"),
        ("t.json", '{"mug": "tall"}', "'mug' .*'tall' is not a size"),
        ("t.json", '{"mug": true}', "is not a size"),
        ("t.json", "{}", "holds no sizes"),
        ("t.txt", "mug 0.1", "suffix '.txt'"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, name: str, text: str, complaint: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=complaint):
        load_size_table(tmp_path / name)


def test_missing_and_binary_tables_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        load_size_table(tmp_path / "none.csv")
    (tmp_path / "b.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not UTF-8"):
        load_size_table(tmp_path / "b.json")


def test_json_and_csv_of_one_table_agree(tmp_path: Path) -> None:
    table = own_table()
    (tmp_path / "own.json").write_text(json.dumps({entry.phrase: entry.typical_m for entry in table.entries}))
    again = load_size_table(tmp_path / "own.json")
    assert isinstance(again, SizeTable)
    assert len(again.entries) == len(table.entries)
    assert again.typical_m.tolist() == table.typical_m.tolist()
