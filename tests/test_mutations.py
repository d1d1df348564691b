"""The table of mutations, which tests/mutate.py applies."""

from pathlib import Path

from mutations import MUTATIONS

ROOT = Path(__file__).parents[1]


def test_each_mutation_finds_its_text_once_and_the_tests_that_guard_it() -> None:
    texts = {mutation.file: (ROOT / mutation.file).read_text() for mutation in MUTATIONS}
    assert [each.breaks for each in MUTATIONS if texts[each.file].count(each.old) != 1] == []
    assert all((ROOT / name).exists() for each in MUTATIONS for name in each.tests.split())
