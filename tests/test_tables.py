import pytest

from avp_habitat.tables import table

HEAD, ROWS = ["policy", "n"], [["a", "9"], ["greedy one", "10.5"]]


def test_a_markdown_table_has_aligned_columns_and_says_so():
    assert table(HEAD, ROWS, words=1).splitlines() == [
        "| policy     |    n |",
        "| ---------- | ---: |",
        "| a          |    9 |",
        "| greedy one | 10.5 |",
    ]


def test_a_plain_table_has_no_bars_and_no_blanks_at_the_end():
    assert table(HEAD, ROWS, markdown=False).splitlines() == ["policy      n", "a           9", "greedy one  10.5"]


def test_a_row_that_lacks_a_cell_is_refused():
    with pytest.raises(ValueError, match="zip"):
        table(HEAD, [["a"]])
