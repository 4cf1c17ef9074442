"""What users see of public names: signatures, docstrings and their references, completion, and printed results."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.features.arguments import knobs_of
from tiverlet.features.feature import Feature

ROOT = Path(__file__).parents[1]
PUBLIC = {name: getattr(tv, name) for name in tv.__all__ if name != "play"}
CLASSES = {name: kind for name, kind in PUBLIC.items() if inspect.isclass(kind)}
WRITTEN_BY_WORLDS = {"StepReport", "SweepResult"}  # nobody calls them


def docstrings() -> dict[str, str]:
    """Return the docstrings of public names, of what modules among them list, and of public methods of classes, by name."""
    things = dict(PUBLIC)
    for name, thing in PUBLIC.items():
        names = getattr(thing, "__all__", ()) if inspect.ismodule(thing) else ()
        if name in CLASSES:
            names = [n for n in vars(thing) if not n.startswith("_") and not issubclass(CLASSES[name], Feature)]
        things |= {f"{name}.{n}": inspect.getattr_static(thing, n) for n in names}
    return {name: text for name, thing in things.items() if (text := thing.__doc__)}


def leads_somewhere(name: str, of: str) -> bool:
    """Whether a reference in the docstring of a public name is a public name, an attribute of one, or a page."""
    if name.endswith(".md"):
        return (ROOT / name).is_file()
    owners = [tv, *(PUBLIC[part] for part in [of.partition(".")[0]] if part in PUBLIC)]
    for owner in owners:
        thing = owner
        try:
            for part in name.removeprefix("tv.").split("."):
                thing = inspect.getattr_static(thing, part) if inspect.isclass(thing) else getattr(thing, part)
        except AttributeError:
            continue
        return True
    return hasattr(tv.World, name.removeprefix("world.")) if name.startswith("world.") else False


def test_signatures_and_docstrings_fit_a_screen():
    called = {name for name, thing in PUBLIC.items() if callable(thing)} - WRITTEN_BY_WORLDS
    assert not [name for name in called if len(str(inspect.signature(PUBLIC[name]))) > 350]
    assert not [name for name, kind in CLASSES.items() if len((kind.__doc__ or "").splitlines()) > 26]  # 25, one that closes
    # The alias of NumPy, which is for type checkers, has its name: its text has 230 characters.
    assert str(inspect.signature(tv.Gravity)).count("ArrayLike") == 1


def test_references_in_public_docstrings_lead_somewhere():
    dangling = []
    for of, text in docstrings().items():
        prose = " ".join(text.split())
        names = re.findall(r"\b[Ss]ee (?:the )?`?((?:tv\.)?[A-Z]\w+(?:\.\w+)*|[\w/.]+\.(?:md|py)|tv\.[\w.]*\w|world\.\w+)", prose)
        names += re.findall(r"(?<![\w.])(tv\.[\w.]*\w)", prose)
        dangling += [f"{of}: {name}" for name in names if not leads_somewhere(name.removesuffix("()"), of)]
    assert not dangling


@pytest.fixture(scope="module")
def pair():
    """Return a world of two linked discs that fall on a wall, after some frames."""
    start = tv.Particles([[0.0, 0.11], [1.0, 0.11]], radius=0.1)
    link, floor = tv.Distance([[0, 1]]), tv.HalfSpace((0, 1), events=True)
    world = tv.World(start, [tv.Gravity(), link, tv.Contact(events=True), floor], substeps=4)
    world.run(0.1)
    yield world
    world.close()


@pytest.mark.slow
def test_completion_of_features_and_solvers_shows_arguments_and_results(pair):
    link = pair.features[1]
    names = ["arguments", "break_at", "broken", "compliance", "count", "damping", "indices", "load", "residual", "rest"]
    assert set(dir(link)) <= {*names} and {*names} - {"arguments"} <= set(dir(link))
    assert dir(tv.Direct()) == ["width"] and "clearance" in dir(pair.features[3])
    for feature in pair.features:
        kind = type(feature)
        assert {*knobs_of(kind)} <= {*dir(feature)} and all(hasattr(feature, name) for name in dir(feature))


def test_what_completion_adds_is_documented_and_shows_what_classes_of_the_user_define():
    for name, kind in CLASSES.items():
        for base in kind.__mro__:
            for what in vars(base).get("for_users", ()):
                assert inspect.getattr_static(kind, what).__doc__, f"{name}.{what}"
    own = type("Own", (tv.Gravity,), {"planet": lambda self: "Mars"})
    assert {"g", "planet"} <= {*dir(own(3.7))}


@pytest.mark.slow
def test_events_contacts_and_hits_fit_a_screen():
    n = 400
    start = tv.Particles(tv.golden(np.arange(n), dim=2) * 3, radius=0.08)
    with tv.World(start, [tv.Contact(events=True), tv.Box((0, 0), (3, 3), events=True)], substeps=1) as world:
        world.step(1e-3)
        found = (
            world.contacts,
            world.events(),
            world.wall_events(),
            world.ray(np.full((30, 2), 5.0), (-1, -1)),
            world.ray((5, 5), (0, 1)),
        )
        assert len(found[0]) > 100
        for thing in found:
            lines = repr(thing).splitlines()
            assert len(lines) <= 24 and max(map(len, lines)) <= 120
        assert repr(found[0]).startswith(f"Contacts: {len(found[0])}\n") and "more" in repr(found[0])
