"""The demos run, and the README tells the truth about the first of them."""

import pathlib
import re

import pytest

from .conftest import python

ROOT = pathlib.Path(__file__).parent.parent


def test_hello_is_the_readmes_example_and_runs(tmp_path):
    script = (ROOT / "demos" / "hello.py").read_text()
    shown = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert shown and shown.group(1).strip() == script.split('"""', 2)[2].strip()
    done = python(script)
    printed = (ROOT / "README.md").read_text().split("```\n")
    block = next(b for b in printed if b.startswith("StepReport("))
    # The report's figures may differ between processors; what the scene is made of may not, but for the number of threads.
    want, got = (re.sub(r"\d+ threads", "threads", text).strip().splitlines() for text in (block, done.stdout))
    assert want[1:] == got[1:] and got[0].startswith("StepReport(time=5.0, substeps=64, iterations=1, residual=0.008")


def test_pay_finds_that_features_only_add():
    assert "bytes per particle" in python((ROOT / "demos" / "pay.py").read_text()).stdout


def test_article_runs_and_checks_itself():
    code = f"""
import sys
sys.path.insert(0, {str(ROOT / "demos")!r})
import article
article.SECONDS = 2.0
article.main("article.rrd")
import os
assert os.path.getsize("article.rrd") > 100_000
"""
    done = python(code)
    assert "frames" in done.stdout and "120" in done.stdout and "worst overlap" in done.stdout


def test_other_demos_check_themselves():
    assert "formula" in python((ROOT / "demos" / "cradle.py").read_text()).stdout
    assert "carries 1.0" in python((ROOT / "demos" / "net.py").read_text()).stdout
    assert "through the neck" in python((ROOT / "demos" / "hourglass.py").read_text()).stdout


@pytest.mark.parametrize("name", ["soft", "bead", "tidy", "cloth", "ragdoll", "machine"])
def test_demos_of_bodies_check_themselves(name):
    assert f"{name}.rrd" in python((ROOT / "demos" / f"{name}.py").read_text()).stdout


def test_polygons_keep_their_corners_out_of_each_other():
    code = f"""
import sys
sys.path.insert(0, {str(ROOT / "demos")!r})
import polygons
polygons.main("polygons.rrd", seconds=1.5)
"""
    assert "36 bodies" in python(code).stdout
