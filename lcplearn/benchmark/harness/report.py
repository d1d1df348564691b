"""`benchmark report`: the findings of several studies on one HTML page that needs no network."""

import base64
import html
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
img { max-width: 100%; }
table { border-collapse: collapse; font-size: 14px; margin: 1em 0; display: block; overflow-x: auto;
  /* a shadow at the right edge where a wide table goes on */
  background: linear-gradient(to left, #fff 30%, #fff0) right / 3rem 100% local no-repeat,
    linear-gradient(to left, #0003, #0000) right / 1rem 100% scroll no-repeat #fff; }
td, th { padding: .2em .6em; border-bottom: 1px solid #ddd; text-align: left; }
td { white-space: nowrap; }
pre { background: #f5f5f5; padding: .7em; font-size: 12px; overflow-x: auto; } nav a { margin-right: 1em; }
"""


def write_report(folders: Iterable[str | Path], output: str | Path) -> None:
    """Gather the studies of some folders: first what answers a question, last whether the layer does what it must.

    Folders without a finished study, as that of `fuzz`, are left out with a word.

    Raises:
        ValueError: No folder has a finished study, or one is damaged.
    """
    paths = [Path(folder) for folder in folders]
    finished = [folder for folder in paths if (folder / "summary.json").is_file()]
    if not finished:
        raise ValueError(f"none of {', '.join(map(str, paths))} holds a finished study")
    for folder in paths:
        if folder not in finished:
            sys.stderr.write(f"left out, as it holds no finished study: {folder}\n")
    studies = sorted((_read(folder) for folder in finished), key=lambda study: study[1]["name"] == "acceptance")
    questions, chapters = [], []
    for folder, study in studies:
        sections = study["sections"]
        questions += [_section(folder, section) for section in sections if section["heading"].endswith("?")]
        rest = [_section(folder, section) for section in sections if not section["heading"].endswith("?")]
        header = [line for line in (folder / "results.csv").read_text().splitlines() if line.startswith("#")]
        name = html.escape(study["name"])
        chapters.append(f'<h1 id="{name}">{name}</h1><pre>{html.escape(chr(10).join(header))}</pre>{"".join(rest)}')
    links = "".join(f'<a href="#{html.escape(s["name"])}">{html.escape(s["name"])}</a>' for _, s in studies)
    first = f"<h1>Which method should I use?</h1>{''.join(questions)}" if questions else ""
    page = f"<!doctype html><html lang=en><meta charset=utf-8><title>lcplearn benchmark</title><style>{_STYLE}</style>"
    Path(output).parent.mkdir(parents=True, exist_ok=True)
    Path(output).write_text(f"{page}<nav>{links}</nav>{first}{''.join(chapters)}</html>\n")


def _read(folder: Path) -> tuple[Path, dict[str, Any]]:
    try:
        study = json.loads((folder / "summary.json").read_text())
        return folder, {"name": study["name"], "sections": study["sections"]}
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(f"{folder / 'summary.json'} is damaged: run its command again") from None


def _section(folder: Path, section: dict[str, Any]) -> str:
    parts = [f"<h2>{html.escape(section['heading'])}</h2>"]
    parts += [f"<p>{html.escape(text)}</p>" for text in section["text"].split("\n\n") if text]
    if "figure" in section:
        image = base64.b64encode((folder / section["figure"]).read_bytes()).decode()
        parts.append(f'<img alt="{html.escape(section["heading"])}" src="data:image/png;base64,{image}">')
    if "table" in section:
        parts.append(_table(section["table"]))
    return "".join(parts)


def _table(rows: Sequence[Sequence[str]]) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(rows[0], 'th')}{''.join(line(row, 'td') for row in rows[1:])}</table>"
