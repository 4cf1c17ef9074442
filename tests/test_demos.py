"""The demos run and pass their own checks."""

import functools
import importlib.util
import pathlib

import pytest

import tiverlet as tv

ROOT = pathlib.Path(__file__).parent.parent


def demo(name: str):
    """Return the module of a demo."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "demos" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """Return a function that runs main() of a demo in a folder of its own and returns what it prints.

    built: arguments of the demo's build(). Recordings hold every tenth frame, but all of the article, whose size is tested.
    """
    seldom = functools.partial(tv.Recorder, every=10)

    def run(name: str, *, settings=(), built=None, **arguments) -> str:
        module = demo(name)
        for setting, value in settings:
            setattr(module, setting, value)
        if built:
            module.build = functools.partial(module.build, **built)
        monkeypatch.chdir(tmp_path)
        if name != "article":
            monkeypatch.setattr(tv, "Recorder", seldom)
        module.main(**arguments)
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_article_runs_and_checks_itself(printed, tmp_path):
    text = printed("article", settings=[("SECONDS", 2.0)])
    assert "frames" in text and "120" in text and "worst overlap" in text
    assert (tmp_path / "article.rrd").stat().st_size > 100_000


@pytest.mark.slow
def test_the_article_gains_no_energy_under_auto(taichi):
    # The discs lie on ropes, so a shorter substep cannot correct discs and ropes one after the other. If they were not corrected
    # together, the 78th frame would have 3e7 J instead of 5e4 J, after nine tries with twice the substeps each.
    start = demo("article").build().world
    world = start.clone(substeps="auto")
    energies = [world.step(1 / 60).energy for _ in range(90)]
    for w in (start, world):
        w.close()
    assert all(b - a < 1e-3 * energies[0] for a, b in zip(energies, energies[1:], strict=False))
    assert energies[-1] < 0.4 * energies[0]


@pytest.mark.slow
def test_pay_finds_that_features_only_add(printed):
    assert "bytes per particle" in printed("pay", settings=[("N", 100)])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, arguments, words",
    [
        ("cradle", {}, "formula"),
        # A thread of the net that holds bears 20.8 N at most, as with 4 and 16 times the substeps.
        ("net", {"settings": [("CELLS", 10), ("STRENGTH", 24.0)]}, "times its weight"),
        ("hourglass", {"built": {"grains": 120}, "seconds": 4.0}, "through the neck"),
        ("polygons", {"seconds": 1.0}, "36 bodies"),
        ("cloth", {"built": {"points": 17}, "seconds": 1.5}, "cloth.rrd"),
        ("wrecking", {"settings": [("ROWS", 6), ("COLUMNS", 2)], "seconds": 2.5}, "before they were hit"),
        ("jelly", {"settings": [("CELLS", 4)]}, "of its height"),
        ("flag", {"settings": [("POINTS", (13, 9))], "seconds": 1.2}, "where the wind blew"),
        ("galaxy", {"settings": [("STARS", 60)], "seconds": 3.0}, "energy kept"),
        ("fit", {"settings": [("THROWS", 60), ("ELITE", 12)]}, "caught in each round"),
        ("pendulums", {"settings": [("SECONDS", 3.0)], "side": 8}, "so a million take"),
        ("stairs", {"built": {"rows": 1}, "seconds": 1.6}, "are down"),
        ("silo", {"settings": [("GRAINS", 200), ("SETTLED", 1.2)], "seconds": 2.4}, "of the weight"),
        ("drum", {"settings": [("GRAINS", 160), ("RADIUS", 0.05)], "seconds": 3.0}, "the heap leans"),
        ("billiards", {}, "all at rest"),
        ("soft", {"seconds": 1.0}, "soft.rrd"),
        ("ragdoll", {"seconds": 1.5}, "ragdoll.rrd"),
        *((name, {}, f"{name}.rrd") for name in ("bead", "tidy", "machine", "buggy")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demos_check_themselves(printed, name, arguments, words):
    # Each demo raises SystemExit if its check fails.
    assert words in printed(name, **arguments)


def test_a_demo_that_fails_gives_no_picture(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("pictures", ROOT / "demos" / "pictures.py")
    assert spec and spec.loader
    pictures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pictures)
    monkeypatch.setattr(pictures.run, "execute", lambda path, arguments: 1)
    with pytest.raises(SystemExit, match="cloth.py ended with 1"):
        pictures.scene(str(tmp_path), "cloth", 1, pictures.ALL)
