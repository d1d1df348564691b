"""Each Python block of README and docs runs, page by page, as a reader would paste it."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [page for page in (ROOT / "README.md", *DOCS) if "```python" in page.read_text()]
NOT_RUN = "# not run:"  # the first line of a block that needs what a test has not, with the reason


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(), flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_of_a_page_runs_as_printed(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "examples"))  # where docs/extending.md lets its reader stand
    scope: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(blocks(page), start=1):
        if not block.startswith(NOT_RUN):
            exec(compile(block, f"{page.name}, block {number}", "exec"), scope)
