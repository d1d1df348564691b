"""The site's pages that stand elsewhere in the repository, links that work both there and here, and mathematics.

NOTES.md becomes three pages. A line that is only a link to a file in examples/ becomes that file. Formulas become
MathML while the site is built, so that it needs no script and no network.
"""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "CITATION.cff": "CITATION.cff",
    "data/README.md": "data.md",
}
NOTES = {  # page: its title, and the sections that stand on it
    "theory.md": ("Theory", (1, 2, 4, 5, 6)),
    "kernel.md": ("The CPU kernel", (3,)),
    "decisions.md": ("Decisions, errata, measurements", (7, 8, 9, 10)),
}
LINK = re.compile(r"\]\((?:\.\./)?(docs/|" + "|".join(map(re.escape, PAGES)) + r")")
NOTES_LINK = re.compile(r"\]\((?:\.\./)?NOTES\.md(?=#(\d+)|\))")
EXAMPLE = re.compile(r"\]\((?:\.\./)?examples/")
WHOLE_FILE = re.compile(r"^\[(examples/[\w/]+\.(py|yaml))\]\(\S+\)$", re.MULTILINE)
FORMULA = re.compile(r'(<(?:span|div) class="arithmatex">)\\([(\[])(.*?)\\[)\]](</(?:span|div)>)', re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    head, *sections = re.split(r"^(?=## )", (ROOT / "NOTES.md").read_text(), flags=re.MULTILINE)
    intro = head.partition("\n")[2]
    for page, (title, numbers) in NOTES.items():
        chosen = "".join(section for section in sections if int(section[3:].partition(".")[0]) in numbers)
        files.append(File.generated(config, page, content=f"# {title}\n{intro}{chosen}"))
    for path in (ROOT / "examples").rglob("*"):
        if path.suffix in (".py", ".ipynb", ".yaml"):
            files.append(File.generated(config, str(path.relative_to(ROOT)), content=path.read_text()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Show whole files, and turn links between files of the repository into links between pages."""
    markdown = WHOLE_FILE.sub(_whole_file, markdown)
    markdown = LINK.sub(lambda link: "](" + PAGES.get(link[1], ""), markdown)
    markdown = NOTES_LINK.sub(lambda link: "](" + _notes_page(int(link[1] or 1)), markdown)
    return EXAMPLE.sub("](examples/", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Turn formulas into MathML."""
    return FORMULA.sub(_formula, content)


def _notes_page(section: int) -> str:
    """The page with a section; its anchor is the one that repositories make of its heading."""
    pages = {each: page for page, (_, sections) in NOTES.items() for each in sections}
    return pages.get(section) or pages[section // 10]  # of 57-contacts..., section 5.7, it is 5


def _whole_file(link: re.Match[str]) -> str:
    language = {"py": "python", "yaml": "yaml"}[link[2]]
    return f'```{language} title="{link[1]}"\n{(ROOT / link[1]).read_text()}```'


def _formula(found: re.Match[str]) -> str:
    start, kind, latex, end = found.groups()
    return start + convert(html.unescape(latex), display="block" if kind == "[" else "inline") + end
