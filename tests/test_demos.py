"""The demos run, and the README tells the truth about the first of them."""

import functools
import importlib.util
import pathlib
import re

import pytest

from .conftest import python

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """What a demo prints: its main() is called in a folder of its own. built: arguments of its build()."""

    def run(name: str, *, settings=(), built=None, **arguments) -> str:
        spec = importlib.util.spec_from_file_location(name, ROOT / "demos" / f"{name}.py")
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        for setting, value in settings:
            setattr(module, setting, value)
        if built:
            module.build = functools.partial(module.build, **built)
        monkeypatch.chdir(tmp_path)
        module.main(**arguments)
        return capsys.readouterr().out

    return run


def test_hello_is_the_readmes_example_and_runs():
    script = (ROOT / "demos" / "hello.py").read_text()
    shown = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert shown and shown.group(1).strip() == script.split('"""', 2)[2].strip()
    done = python(script)
    blocks = (ROOT / "demos" / "README.md").read_text().split("```\n")
    block = next(b for b in blocks if b.startswith("StepReport("))
    # The report's figures may differ between processors; what the scene is made of may not, but for the number of threads.
    want, got = (re.sub(r"\d+ threads", "threads", text).strip().splitlines() for text in (block, done.stdout))
    head = re.match(r"StepReport\(time=5.0, substeps=\d+, iterations=1, residual=0.0\d\d", want[0])
    assert want[1:] == got[1:] and head and got[0].startswith(head[0])


def test_article_runs_and_checks_itself(printed, tmp_path):
    text = printed("article")
    assert "frames" in text and "480" in text and "worst overlap" in text
    assert (tmp_path / "article.rrd").stat().st_size > 100_000


def test_pay_finds_that_features_only_add(printed):
    assert "bytes per particle" in printed("pay", settings=[("N", 1000)])


@pytest.mark.parametrize(
    "name, arguments, words",
    [
        ("cradle", {}, "formula"),
        ("net", {"settings": [("CELLS", 12), ("STRENGTH", 20.0)]}, "times its weight"),
        ("hourglass", {"built": {"grains": 500}}, "through the neck"),
        ("polygons", {}, "36 bodies"),
        ("cloth", {"built": {"points": 23}}, "cloth.rrd"),
        *((name, {}, f"{name}.rrd") for name in ("soft", "bead", "tidy", "ragdoll", "machine")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demos_check_themselves(printed, name, arguments, words):
    # Each raises SystemExit where its check fails.
    assert words in printed(name, **arguments)


def test_a_demo_that_fails_gives_no_picture(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("pictures", ROOT / "demos" / "pictures.py")
    assert spec and spec.loader
    pictures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pictures)
    monkeypatch.setattr(pictures.run, "execute", lambda path, arguments: 1)
    with pytest.raises(SystemExit, match="cloth.py ended with 1"):
        pictures.scene(str(tmp_path), "cloth", 1, 0.0, 1.0)
