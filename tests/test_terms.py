"""Names from other programs, read or passed: errors say what they are called here, and what they say exists."""

import inspect
import re
from typing import Any

import pytest

import tiverlet as tv
from tiverlet.contact.pair_contact import PairContact
from tiverlet.contact.rays import Hits
from tiverlet.contact.touches import Touches
from tiverlet.features.feature import Batch, Feature
from tiverlet.features.unknown_names import rows, terms
from tiverlet.neighbours.queries import Contacts
from tiverlet.recording.replay import Replay

X, LINK = [[0.0, 0.0], [1.0, 0.0]], [[0, 1]]


@pytest.fixture(scope="module")
def scene():
    """Return a world whose attributes are read, and never one that fails."""
    start, walls = tv.Particles(X, radius=0.1, orientation=0.0), [tv.Contact(), tv.HalfSpace((0, 1), -1.0)]
    w = tv.World(start, [tv.Gravity(), tv.Distance(LINK), *walls])
    w.step(0.01)
    yield w
    w.close()


def rows_of(name: str) -> list[tuple[str, str]]:
    """Return the rows of an owner: names, and the clause that answers them."""
    return [(names, clause) for owners, found in rows().items() if name in owners.split() for names, clause in found.items()]


@pytest.mark.slow
def test_every_term_of_others_is_answered(scene):
    # Where it is read of what users hold, and where it is given to what they call.
    link, contact, wall = scene.features[1:]
    read = {
        "tiverlet": tv, "tiverlet.measure": tv.measure, "tiverlet.shapes": tv.shapes,
        "World": scene, "Worlds": tv.Worlds(scene, 2),
        "Particles": scene.particles, "Feature": scene.features[0], "Batch": link, "Collider": wall, "PairContact": contact,
        "StepReport": scene.last, "Contacts": scene.contacts, "Hits": scene.ray((5.0, 5.0), (0, -1)),
        "Shape": tv.shapes.rope((0, 0), (1, 0), 3),
    }  # fmt: skip
    called = {"World.step": scene.step, "World.run": scene.run, "Batch": tv.Distance, "PairContact": tv.Contact}
    named = {name: getattr(tv, name, None) or getattr(tv.shapes, name, None) for name in terms()}
    called |= {name: call for name, call in named.items() if callable(call) and name not in ("StepReport", "Shape")}
    asked = 0
    for name in terms():
        for words, clause in rows_of(name):
            for term in words.split():
                if name in read and not hasattr(read[name], term):
                    asked += 1
                    with pytest.raises(AttributeError, match=re.escape(clause)):
                        getattr(read[name], term)
                if name in called:
                    asked += 1
                    with pytest.raises(TypeError, match=re.escape(clause)):
                        called[name](**{term: 1.0})
    assert asked > 900


@pytest.mark.parametrize(
    "ask, kind, words",
    [
        (lambda w: tv.Distnace, AttributeError, "did you mean 'Distance'"),
        (lambda w: w.GetPosition, AttributeError, "did you mean 'position'"),
        (lambda w: tv.shapes.Rope, AttributeError, "did you mean 'rope'"),
        (lambda w: tv.shapes.circle, AttributeError, "a filled one is ball"),
        (lambda w: setattr(w, "gravity", (0, -1)), AttributeError, "cannot be set; it is a feature"),
        (lambda w: setattr(w, "mass", 3), AttributeError, "cannot be set; make tv.Particles for a new world. Live are"),
        (lambda w: setattr(w.features[1], "stiffness", 5.0), AttributeError, "write compliance = 1 / stiffness. Live are"),
        (lambda w: tv.World(w.particles, sub_steps=4), TypeError, "did you mean 'substeps'"),
        (
            lambda w: tv.Distance(LINK, frequencyHz=4.0),
            TypeError,
            r"frequency.*. It takes pairs, rest, compl",
        ),
        (lambda w: tv.Contact(0.3, 0.5, 0.1), TypeError, "3 arguments, but 2 without a name; write skin=, groups="),
        (lambda w: tv.Particles(), TypeError, "missing a required argument: 'position'"),
        (lambda w: w.hash(1), TypeError, "1 arguments, but 0 without a name"),
    ],
)
def test_misspelt_names_and_arguments_that_do_not_fit_are_answered(scene, ask, kind, words):
    with pytest.raises(kind, match=words):
        ask(scene)


def test_an_error_inside_of_a_call_stays_what_it_is(scene):
    # A call that fits raises its own TypeError, and a knob that waits for its world says so.
    with pytest.raises(TypeError, match="dt = 'x' is a str"):
        scene.step("x")
    with pytest.raises(AttributeError, match="has no rest before it is in a World"):
        _ = tv.Distance(LINK).rest
    assert str(inspect.signature(tv.Drag)) == "(rate)" and not hasattr(scene, "__array__")


OWNERS: dict[str, Any] = {
    "Feature": Feature, "Batch": Batch, "PairContact": PairContact, "Contacts": Contacts, "Touches": Touches, "Hits": Hits,
    "Replay": Replay, "tiverlet": tv,
    "tiverlet.measure": tv.measure, "tiverlet.shapes": tv.shapes, "Collider": tv.Box.__mro__[2], "Shape": tv.shapes.Shape,
}  # fmt: skip


def owner(name: str) -> Any:
    """Return the class, module or function that a table of terms belongs to."""
    if name in OWNERS:
        return OWNERS[name]
    kind, _, method = name.partition(".")
    found = getattr(tv, kind, None) or getattr(tv.shapes, kind)
    return getattr(found, method) if method else found


def names_of(thing: Any) -> set[str]:
    """Return the names that exist: arguments of a call, or attributes where nothing is called."""
    plain = inspect.ismodule(thing) or "__init__" not in vars(thing) and not inspect.isfunction(thing)
    return {n for n in {*dir(thing), *vars(thing)} if not n.startswith("_")} if plain else {*inspect.signature(thing).parameters}


@pytest.mark.parametrize("name", terms())
def test_terms_are_of_others_and_their_answers_exist(name, scene):
    given = rows_of(name)
    asked = [one for names, _ in given for one in names.split()]
    assert len({*asked}) == len(asked) and not {*asked} & names_of(owner(name))  # no name twice, and none that exists
    for _, clause in given:
        for path, arguments in re.findall(r"\btv\.([\w.]*\w)(?:\(((?:[^()]|\([^()]*\))*)\))?", clause):
            thing = tv
            for part in path.split("."):
                thing = getattr(thing, part)
            for keyword in re.findall(r"(\w+)=(?!=)", re.sub(r"\btv\.\w+\([^()]*\)", "", arguments)):
                assert keyword in inspect.signature(thing).parameters, clause
        for place in re.findall(r"\bworld\.([\w.]*\w)", clause):
            thing = scene
            for part in place.split("."):
                thing = getattr(thing, part)
