"""The pages that `make book` built: `pytest -m book`; what a browser makes of them is in test_browser."""

import re

import pytest

from inflate_lib import paths
from inflate_lib.book.run import find_notebooks

pytestmark = pytest.mark.book
NAMES = [path.stem for path in find_notebooks()]


def test_pages_ask_no_other_server_for_anything():
    pages = sorted((paths.BOOK / "_build" / "html").rglob("*.html"))
    assert len(pages) > len(find_notebooks())
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loads = re.findall(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=\"((?:https?:)?//[^\"]+)", text)
        assert not loads, f"{page.name} loads {loads[0]}"


@pytest.mark.parametrize("name", NAMES)
def test_injected_parameters_do_not_show(name):
    text = (paths.BOOK / "_build" / "html" / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
    assert "tag_parameters" in text
    assert "tag_injected-parameters" not in text


@pytest.mark.parametrize("name", NAMES)
def test_every_table_has_its_number_and_caption(name):
    text = (paths.BOOK / "_build" / "html" / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
    tables = re.findall(r'<figure class="captioned-table.*?</figure>', text, re.DOTALL)
    numbers = [re.search(r'class="caption-number">Table \d+\.(\d+) ', table) for table in tables]
    assert [int(number[1]) for number in numbers] == list(range(1, len(tables) + 1))
    assert all(re.search(r'class="caption-text">\w', table) for table in tables)
    assert all(table.index("</figcaption>") < table.index('class="dataframe"') for table in tables)
    assert text.count('class="dataframe"') == len(tables), "a table outside, or two in one"
