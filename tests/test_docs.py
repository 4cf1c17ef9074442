"""The documentation pages: their code runs, their links resolve, the first page is short, and public names have docstrings."""

import ast
import importlib.util
import inspect
import pathlib
import re

import pytest

import tiverlet as tv
from tiverlet.device.language import COMPILER
from tiverlet.features.arguments import knobs_of

from .conftest import parsed
from .laboratory import pages, results
from .laboratory.__main__ import EXPERIMENTS

ROOT = pages.ROOT
PAGES = [page.relative_to(ROOT) for page in pages.PAGES]


def blocks(page: pathlib.Path) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.S | re.M)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p)], ids=str)
def test_code_runs(page, tmp_path, monkeypatch, capsys, briefly):
    # In reading order, each page in a file of its own, since Taichi reads the source of functions.
    script = tmp_path / "page.py"
    script.write_text("\n\n".join(blocks(page)).replace("import taichi as ti", f"import {COMPILER} as ti"))
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location("page", script)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for value in vars(module).values():
        if hasattr(value, "close") and hasattr(value, "step"):
            value.close()
    if page.parts == ("README.md",):
        # The page begins with demos/hello.py, which prints what its page shows. The figures of the report may differ between
        # processors; what the scene is made of may not, apart from the number of threads.
        assert blocks(page)[0].strip() == (ROOT / "demos" / "hello.py").read_text().split('"""', 2)[2].strip()
        shown = (ROOT / "demos" / "README.md").read_text().split("```\n")
        shown = next(block for block in shown if block.startswith("StepReport("))
        want, got = (re.sub(r"\d+ threads", "threads", text).strip().splitlines() for text in (shown, capsys.readouterr().out))
        head = re.match(r"StepReport\(time=5.0, substeps=\d+, iterations=1, residual=0.0\d\d", want[0])
        assert want[1:] == got[1 : len(want)] and head and got[0].startswith(head[0])


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text()
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M))
    missing = [link for link in links if "://" not in link and not ((ROOT / page).parent / link).exists()]
    assert not missing


def test_files_that_pages_name_are_there():
    # `name.py` in a folder's page is a file of that folder, of a folder below it, or of the repository.
    for page in PAGES:
        for name in re.findall(r"`([\w/]+\.(?:py|json))`", (ROOT / page).read_text()):
            assert (ROOT / name).exists() or any((ROOT / page).parent.rglob(name)), f"{page}: {name}"
    # And so are the tests that code names.
    sources = [*parsed(), *(ROOT / "tests").rglob("*.py")]
    named = {(path.name, name) for path in sources for name in re.findall(r"\b(test_\w+\.py)", path.read_text())}
    assert not [(of, name) for of, name in named if not (ROOT / "tests" / name).exists()]


def test_the_first_page_is_short_and_leads_to_all_others():
    text = (ROOT / "README.md").read_text()
    assert len(text.encode()) <= 8192
    assert all(str(page) in text for page in PAGES[1:])


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_figures_in_tables_are_those_of_the_laboratory(page):
    # `python -m tests.laboratory NAME --write` writes them.
    text = (ROOT / page).read_text()
    assert not pages.unwritten(text)
    assert set(re.findall(r"python -m tests\.laboratory (\w+)", text)) <= EXPERIMENTS.keys()
    assert pages.filled(text, results.FILE.read_text()) == text


def undocumented(tree: ast.Module) -> list[str]:
    """Return the names without a docstring, including nested ones and property setters, except names that begin with _."""
    out = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        out += [] if ast.get_docstring(node, clean=False) else [f"{node.lineno} {node.name}"]
    return out


def test_every_public_name_says_what_it_is():
    # Modules, classes, functions, methods, properties and their setters, and nested definitions of the package; and knobs,
    # whose docstring is given when they are defined.
    missing = []
    for path, tree in parsed().items():
        name = str(path.relative_to(ROOT))
        missing += [] if ast.get_docstring(tree, clean=False) else [name]
        missing += [f"{name}:{what}" for what in undocumented(tree)]
    kinds = [kind for kind in vars(tv).values() if inspect.isclass(kind)]
    missing += [f"{kind.__name__}.{knob}" for kind in kinds for knob in knobs_of(kind) if not getattr(kind, knob).__doc__]
    assert not missing


def test_pages_are_short():
    # A page says the law, the options, the limits and how to write one; what is longer is beside the code or generated.
    long = {str(page): len((ROOT / page).read_bytes()) for page in PAGES if "report" not in page.parts}
    changes = long.pop("tiverlet/CHANGELOG.md")
    assert changes <= 12288 and not {page: size for page, size in long.items() if size > 8192}
