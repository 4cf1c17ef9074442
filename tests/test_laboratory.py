"""The laboratory: every experiment can be asked for, results are kept by section, and one experiment runs."""

import pathlib
import re
from importlib import import_module

import pytest

from tiverlet.report.output import Table

from .conftest import python
from .laboratory import mutations, pages, pay, results
from .laboratory.__main__ import EXPERIMENTS

FOLDER = pathlib.Path(results.__file__).parent


def test_every_experiment_is_listed_and_told_of():
    mains = {path.stem for path in FOLDER.glob("*.py") if re.search(r"^def main\(args\)", path.read_text(), re.M)}
    assert mains == set(EXPERIMENTS)
    assert all(f"`{name}`" in (FOLDER / "README.md").read_text() for name in EXPERIMENTS)
    assert all(callable(import_module(f"tests.laboratory.{name}").main) for name in EXPERIMENTS)


def test_results_replace_those_of_the_same_experiment(tmp_path):
    file = tmp_path / "RESULTS.md"
    for name, cell in (("b", "1"), ("a", "2"), ("b", "3")):
        table = Table("Title", ("head", "other"), [(cell, "x")], ["a note"])
        results.write(name, f"python -m tests.laboratory {name}", [table], file)
    text = file.read_text()
    assert re.findall(r"^## (\w+)$", text, re.M) == ["a", "b"] and text.startswith(results.HEAD)
    assert "| 2 | x |" in text and "| 3 | x |" in text and "| 1 | x |" not in text and text.count("- a note") == 2
    assert re.search(r"`python -m tests.laboratory b`: \d{4}-\d\d-\d\d, .* cores, .*, commit ([0-9a-f]{7,}\+?|unknown)\.", text)


def test_tables_on_pages_are_parts_of_results():
    table = Table("Title", ("case", "error", "time"), [("a", "1e-3 m", "5"), ("b", "2e-3 m", "6")])
    kept = f"{results.HEAD}## sums\n\n`python -m tests.laboratory sums`: today.\n\n{table.markdown()}\n"
    page = "Text.\n\nBy `python -m tests.laboratory sums --write`:\n\n| case | time | error |\n|---|---|---|\n{}\nMore.\n"
    assert pages.filled(page.format("| b | 0 | 1e9 |\n| a |\n"), kept) == page.format("| b | 6 | 2e-3 m |\n| a | 5 | 1e-3 m |\n")
    empty = page.format("")
    for wrong in (page.format("| c | 5 | 1 m |\n"), empty.replace("time", "cost"), empty.replace("sums", "none")):
        with pytest.raises(LookupError, match=r"RESULTS.md has in its section (sums|none) no table"):
            pages.filled(wrong, kept)
    by_hand = "A table:\n\n| a | b |\n|---|---|\n{}"
    for figure in ("0.5", "4", "-3e-7 m", "12 ms", "55,000 (least 31)", "9.8; 0.2", "25 us a launch", "~3 %"):
        assert pages.unwritten(by_hand.format(f"| x | {figure} |\n")) == [figure]
    for words in ("4096 substeps were too few", "`height=1.8`", "above 0.05 of a length", "1 visit per pass", "yes", ""):
        assert not pages.unwritten(by_hand.format(f"| x | {words} |\n"))


def test_the_price_list_has_the_fields_and_bytes_of_today(taichi):
    # `python -m tests.laboratory pay --write` writes it; times are measured there alone.
    kept = results.sections(results.FILE.read_text())["pay"]
    ((_, heads, rows),) = pages.tables(kept)
    assert tuple(heads) == pay.HEADS
    assert [tuple(row[:3]) for row in rows] == [row[:3] for row in pay.price_list(0).rows]


def test_faults_that_can_be_put_back_are_where_they_were():
    for fault in mutations.FAULTS:
        assert (mutations.ROOT / "tiverlet" / fault.file).read_text().count(fault.now) == 1, fault
        assert all(mutations.file_of(test) for test in fault.tests.split()), fault


@pytest.mark.slow
def test_an_experiment_runs():
    # The cheapest one with a process of its own and, where there is a compiler, the pile in C.
    code = "from tests.laboratory.__main__ import main\nmain('speed pile --sizes 41 --threads 1 --quick'.split())"
    shown = python(code, PYTHONPATH=str(FOLDER.parents[1])).stdout
    assert "Starts, memory, quality" in shown and "Missing" not in shown and re.search(r"^pile +41 +1 ", shown, re.M)
