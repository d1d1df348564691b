"""The form of a benchmark: rows that survive, tables, figures, and the page that gathers them."""

import re

import pytest

from lcplearn.benchmark.__main__ import main
from lcplearn.benchmark.harness.figures import STYLES, new_figure, style
from lcplearn.benchmark.harness.report import write_report
from lcplearn.benchmark.harness.study import Options, Study, Table, format_table, read_rows

KEY, COLUMNS = ("family", "n"), ("seconds", "solved")


def measure(folder, keys, stop_after=None, **options):
    """Run a study of squares; returns the keys that were measured now."""
    study = Study("squares", Options(folder, **options), KEY, COLUMNS)
    measured = []
    for key in study.remaining(keys, seconds=1.0):
        if len(measured) == stop_after:
            return measured
        study.add(key, {"seconds": float(key[1]) ** 2, "solved": True})
        measured.append(key)
    return measured


KEYS = [(family, n) for family in ("even", "odd, or so") for n in (1, 2, 3)]


def test_a_stopped_study_continues_without_losing_or_repeating_rows(tmp_path):
    assert measure(tmp_path, KEYS, stop_after=4) == KEYS[:4]
    with (tmp_path / "results.csv").open("a") as file:
        file.write("odd, or s")  # killed while it wrote
    assert measure(tmp_path, KEYS) == KEYS[4:]
    assert measure(tmp_path, KEYS) == []
    rows = read_rows(tmp_path / "results.csv")
    assert [(row["family"], row["n"]) for row in rows] == KEYS
    assert [row["seconds"] for row in rows] == [1, 4, 9, 1, 4, 9]


def test_the_header_names_machine_versions_seed_and_commit(tmp_path):
    measure(tmp_path, KEYS[:1], seed=7)
    header = [line for line in (tmp_path / "results.csv").read_text().splitlines() if line.startswith("#")]
    for words in ("seed=7", "machine: ", "versions: Python 3.", "torch 2", "commit: ", "UTC"):
        assert any(words in line for line in header)


def test_a_folder_with_other_settings_is_refused_in_one_sentence(tmp_path):
    measure(tmp_path, KEYS[:1])
    with pytest.raises(ValueError, match=r"seed=0 .* seed=1 .*: use another --output"):
        measure(tmp_path, KEYS, seed=1)


def test_a_row_with_other_columns_is_refused(tmp_path):
    study = Study("squares", Options(tmp_path), KEY, COLUMNS)
    with pytest.raises(ValueError, match="must have"):
        study.add(KEYS[0], {"minutes": 1.0})


def test_a_table_shows_three_digits_and_aligns_numbers_to_the_right():
    table = Table(("method", "time"), [("pivoting", 0.123456), ("x", 12345.6)])
    assert format_table(table).splitlines() == [
        "| method   |  time |",
        "|----------|------:|",
        "| pivoting | 0.123 |",
        "| x        | 12346 |",
    ]


def test_a_pipe_in_a_cell_does_not_split_it_and_there_is_no_minus_zero():
    lines = format_table(Table(("|v| < 0.01", "change"), [(1.0, -0.0)])).splitlines()
    assert lines[0].startswith("| \\|v\\| < 0.01 |")
    assert lines[2].split() == ["|", "1", "|", "0", "|"]


def test_what_the_layer_must_do_comes_last_in_the_report(tmp_path):
    for name in ("acceptance", "squares"):
        study = Study(name, Options(tmp_path / name), KEY, COLUMNS)
        study.say(f"Is {name} right?", "Yes.")
        study.finish()
    write_report([tmp_path / "acceptance", tmp_path / "squares"], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.index("Is squares right?") < page.index("Is acceptance right?")


def test_the_report_is_one_page_without_links_to_elsewhere_and_questions_come_first(tmp_path, capsys):
    study = Study("squares", Options(tmp_path / "squares"), KEY, COLUMNS)
    study.add(KEYS[0], {"seconds": 1.0, "solved": True})
    figure, axes = new_figure()
    axes[0, 0].plot([1, 2], [1, 4], **style("pivoting"), label="pivoting")
    study.say("All squares", "Numbers.", table=Table(("n < 3", "square"), [(1, 1), (2, 4)]), figure=figure)
    study.say("Which square is largest?", "The last.")
    study.finish()
    printed = capsys.readouterr().out
    assert "n < 3" in printed
    assert "What to look at first:\n- Which square is largest?" in printed
    assert (tmp_path / "squares" / "all_squares.png").stat().st_size > 1000
    assert len(list((tmp_path / "squares").glob("events.out.tfevents.*"))) == 1
    main(["report", str(tmp_path / "squares"), "--output", str(tmp_path / "page.html")])
    page = (tmp_path / "page.html").read_text()
    assert page.index("Which square is largest?") < page.index("All squares")
    assert "n &lt; 3" in page
    assert "data:image/png;base64," in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "seed=0" in page


def test_report_of_an_unfinished_study_ends_in_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="holds a finished study"):
        write_report([tmp_path], tmp_path / "page.html")


def test_no_two_methods_look_alike():
    looks = [tuple(value) for name, value in STYLES.items()]
    solvers, models = looks[:6], looks[6:-3]
    assert len(set(solvers)) == len(solvers)
    assert len(set(models)) == len(models)
