"""What an installation brings: a version, public names, a command, types, and calls on pages that type checkers accept."""

import json
import pathlib
import subprocess
import sys
import tomllib

import pytest

import tiverlet as tv
from tests.test_docs import PAGES, ROOT, blocks
from tiverlet.__main__ import main
from tiverlet.commands import run


def test_the_version_is_said_in_one_place(capsys):
    with pytest.raises(SystemExit, match="^0$"):
        main(["--version"])
    assert capsys.readouterr().out == f"tiverlet {tv.__version__}\n"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"] and "version" not in project["project"]
    assert project["tool"]["hatch"]["version"]["path"] == "tiverlet/__init__.py"
    assert f"## {tv.__version__}" in (ROOT / "tiverlet/CHANGELOG.md").read_text()
    assert project["project"]["scripts"] == {"tiverlet": "tiverlet.__main__:main"}


def test_demos_are_listed_and_found(capsys):
    assert main(["demos"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = sorted(path.stem for path in (ROOT / "demos").glob("*.py"))
    assert [line.split()[0] for line in lines[: len(names)]] == names and all(
        len(line.split()) > 3 for line in lines[: len(names)]
    )
    assert all(run.find(name) == ROOT / "demos" / f"{name}.py" for name in names)
    # All demos are in the gallery and in the wheel.
    gallery = (ROOT / "demos/README.md").read_text()
    assert all(f"]({name}.py)" in gallery for name in names)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"] == {"demos": "tiverlet/demos"}


def test_completion_shows_what_is_public():
    assert dir(tv) == sorted([*tv.__all__, "__version__", "report"])
    assert all(getattr(tv, name) is not None for name in dir(tv))


def test_every_extra_is_told_of():
    # The README or the page of its folder names each extra as pip takes it.
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    text = "".join((ROOT / page).read_text() for page in PAGES)
    assert not [name for name in extras if f"[{name}]" not in text and f"`{name}`" not in text]


@pytest.mark.slow
def test_type_checkers_accept_what_the_pages_show(tmp_path):
    # Every call on the pages, and the calls in documented_calls.py; the demos are checked with the package.
    assert (ROOT / "tiverlet/py.typed").is_file()
    (tmp_path / "calls.py").write_text((pathlib.Path(__file__).parent / "documented_calls.py").read_text())
    for k, page in enumerate(page for page in PAGES if blocks(page)):
        (tmp_path / f"page_{k}.py").write_text("\n\n".join(blocks(page)))
    settings = {"include": ["."], "extraPaths": [str(ROOT)], "typeCheckingMode": "basic", "pythonVersion": "3.11"}
    # Kernels are in Taichi's language. Its package has no types, and analysing it takes half of the time.
    settings |= {"useLibraryCodeForTypes": False}
    settings |= {"reportIndexIssue": False, "reportOperatorIssue": False, "reportInvalidTypeForm": False}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--project", str(tmp_path), "--outputjson"]
    said = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    assert said["summary"]["filesAnalyzed"] > 3
    assert not [(d["file"][-12:], d["range"]["start"]["line"] + 1, d["message"]) for d in said["generalDiagnostics"]]
