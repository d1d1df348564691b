"""The site's pages that stand elsewhere in the repository, and links that work both there and here."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = {
    "README.md": "index.md",
    "NOTES.md": "notes.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CITATION.cff": "CITATION.cff",
    "data/README.md": "data.md",
}
LINK = re.compile(r"\]\((?:\.\./)?(docs/|" + "|".join(map(re.escape, PAGES)) + r")")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Turn links between files of the repository into links between pages."""
    return LINK.sub(lambda link: "](" + PAGES.get(link[1], ""), markdown)
