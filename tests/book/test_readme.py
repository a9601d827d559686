"""The generated parts of README.md and of the book's first page are those that their sources give now."""

import pytest

from inflate_lib.book.readme import PAGES, _renewed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_generating_a_page_changes_nothing(page):
    text = page.read_text(encoding="utf-8")
    assert _renewed(text, PAGES[page]) == text, "make readme"


def test_a_changed_part_is_made_anew_and_the_rest_left_alone():
    text = "a\n<!-- quickstart -->\nlast year\n<!-- end of quickstart -->\n"
    text += "b\n<!-- results -->\n\n<!-- end of results -->\nc\n"
    names = ("quickstart", "results")
    new = _renewed(text, names)
    assert "last year" not in new and "label_image(" in new
    assert new.startswith("a\n<!-- quickstart -->\n```python\n") and new.endswith("\n<!-- end of results -->\nc\n")
    assert _renewed(new, names) == new


@pytest.mark.parametrize("text", ["", "<!-- quickstart -->\n1\n<!-- end of quickstart -->\n" * 2])
def test_a_part_that_is_missing_or_there_twice_is_refused(text):
    with pytest.raises(ValueError, match="must have one part between <!-- quickstart --> and"):
        _renewed(text, ("quickstart",))
