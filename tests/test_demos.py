"""What demos have beside what they show: CI runs them all, as a user does, and each checks itself."""

import importlib.util
import pathlib

import pytest

from tiverlet.commands.play import load_world

DEMOS = pathlib.Path(__file__).parent.parent / "demos"


def demo(name: str):
    """Return the module of a demo."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in DEMOS.glob("*.py") if "def play(" in path.read_text()])
def test_demos_have_worlds_to_play(name, taichi):
    found, _ = load_world(str(DEMOS / f"{name}.py"))
    assert found.explain()
    found.close()


@pytest.mark.slow
def test_the_article_gains_no_energy_under_auto(taichi):
    # The discs lie on ropes, so a shorter substep cannot correct discs and ropes one after the other. If they were not corrected
    # together, the 78th frame would have 3e7 J instead of 5e4 J, after nine tries with twice the substeps each.
    world = demo("article").build(substeps="auto").world
    energies = [world.step(1 / 60).energy for _ in range(90)]
    world.close()
    assert all(b - a < 1e-3 * energies[0] for a, b in zip(energies, energies[1:], strict=False))
    assert energies[-1] < 0.4 * energies[0]


def test_a_demo_that_fails_gives_no_picture(tmp_path, monkeypatch):
    pictures = demo("pictures")
    monkeypatch.setattr(pictures.run, "execute", lambda path, arguments: 1)
    with pytest.raises(SystemExit, match="cloth.py ended with 1"):
        pictures.scene(str(tmp_path), "cloth", 1, pictures.ALL)
