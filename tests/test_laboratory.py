"""The laboratory: every experiment can be asked for, results are kept by section, and one experiment runs."""

import pathlib
import re
from importlib import import_module

import pytest

from tiverlet.report.output import Table

from .conftest import python
from .laboratory import mutations, results
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


def test_faults_that_can_be_put_back_are_where_they_were():
    for fault in mutations.FAULTS:
        assert (mutations.ROOT / "tiverlet" / fault.file).read_text().count(fault.now) == 1, fault
        assert all((mutations.ROOT / "tests" / f"test_{test}.py").exists() for test in fault.tests.split()), fault


@pytest.mark.slow
def test_an_experiment_runs():
    # The cheapest one with a process of its own and, where there is a compiler, the pile in C.
    code = "from tests.laboratory.__main__ import main\nmain('speed pile --sizes 41 --threads 1 --quick'.split())"
    shown = python(code, PYTHONPATH=str(FOLDER.parents[1])).stdout
    assert "Starts, memory, quality" in shown and "Missing" not in shown and re.search(r"^pile +41 +1 ", shown, re.M)
