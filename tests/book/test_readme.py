"""The generated parts of README.md are those that their sources give now."""

import pytest

from inflate_lib import paths
from inflate_lib.book.readme import _renewed


def test_generating_the_readme_changes_nothing():
    text = (paths.ROOT / "README.md").read_text(encoding="utf-8")
    assert _renewed(text) == text, "make readme"


def test_a_changed_part_is_made_anew_and_the_rest_left_alone():
    text = (
        "a\n<!-- quickstart -->\nold\n<!-- end of quickstart -->\nb\n<!-- results -->\n\n<!-- end of results -->\nc\n"
    )
    new = _renewed(text)
    assert "old" not in new and "label_image(" in new
    assert new.startswith("a\n<!-- quickstart -->\n```python\n") and new.endswith("\n<!-- end of results -->\nc\n")
    assert _renewed(new) == new


@pytest.mark.parametrize("text", ["", "<!-- quickstart -->\n1\n<!-- end of quickstart -->\n" * 2])
def test_a_part_that_is_missing_or_there_twice_is_refused(text):
    with pytest.raises(ValueError, match="must have one part between <!-- quickstart --> and"):
        _renewed(text)
