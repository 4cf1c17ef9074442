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
from tiverlet.features.terms import ROWS, TERMS
from tiverlet.neighbours.queries import Contacts
from tiverlet.recording.replay import Replay

X, LINK, CORNERS = [[0.0, 0.0], [1.0, 0.0]], [[0, 1]], ((0.0, 0.0), (1.0, 1.0))


@pytest.fixture(scope="module")
def scene():
    """Return a world whose attributes are read, and never one that fails."""
    start, walls = tv.Particles(X, radius=0.1, orientation=0.0), [tv.Contact(), tv.HalfSpace((0, 1), -1.0)]
    w = tv.World(start, [tv.Gravity(), tv.Distance(LINK), *walls])
    w.step(0.01)
    yield w
    w.close()


@pytest.mark.parametrize(
    "read, words",
    [
        (lambda w: tv.Space, r"write tv.World\(particles, features\)"),
        (lambda w: tv.DampedSpring, r"write tv.Distance\(pairs, rest, compliance=1 / stiffness"),
        (lambda w: tv.backend, r"write tv.init\(arch="),
        (lambda w: tv.Distnace, "did you mean 'Distance'"),
        (lambda w: w.mass, "write world.particles.mass"),
        (lambda w: w.GetPosition, "did you mean 'position'"),
        (lambda w: w.dt, r"write world.step\(dt\)"),
        (lambda w: w.particles.masses, "did you mean 'mass'"),
        (lambda w: w.features[1].stiffness, "write compliance = 1 / stiffness"),
        (lambda w: w.features[2].forces, "write world.contacts"),
        (lambda w: w.features[3].elasticity, "write restitution"),
        (lambda w: w.last.penetration, "write overlap"),
        (lambda w: w.contacts.depth, "write overlap"),
        (lambda w: w.ray((5.0, 5.0), (0, -1)).fraction, "write distance"),
        (lambda w: tv.shapes.rope((0, 0), (1, 0), 3).edges, "write links"),
        (lambda w: tv.shapes.Rope, "did you mean 'rope'"),
        (lambda w: tv.measure.potential_energy, "write world.last.energy"),
        (lambda w: tv.Worlds(w, 2).num_envs, r"write len\(worlds\)"),
        (lambda w: setattr(w, "gravity", (0, -1)), "cannot be set; it is a feature"),
        (lambda w: setattr(w.features[1], "stiffness", 5.0), "write compliance = 1 / stiffness. Live are"),
    ],
)
def test_an_attribute_of_another_name_is_answered(scene, read, words):
    with pytest.raises(AttributeError, match=words):
        read(scene)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda w: tv.Distance(LINK, frequencyHz=4.0), "write compliance = 1 / "),
        (lambda w: tv.Distance(body_a=0, body_b=1), "its first argument has the indices .* It takes pairs, rest, compliance"),
        (lambda w: tv.Box(*CORNERS, one_way=(0, 1)), "Capsule, Polygon and Mesh take it"),
        (lambda w: tv.Box(width=2.0, height=1.0), r"write its corners: tv.Box\(lower, upper\)"),
        (lambda w: tv.Contact(0.3, 0.5, 0.1), "3 arguments, but 2 without a name; write skin=, groups="),
        (lambda w: tv.Gravity(y=-9.81), r"write tv.Gravity\(\(0, -9.81\)\)"),
        (lambda w: tv.Particles(X, velocities=0.0), "write velocity|did you mean 'velocity'"),
        (lambda w: tv.Particles(), "missing a required argument: 'position'"),
        (lambda w: tv.World(w.particles, gravity=(0, -9.81)), "it is a feature"),
        (lambda w: tv.World(w.particles, sub_steps=4), "did you mean 'substeps'"),
        (lambda w: w.step(1 / 60, iterations=4), "write world.substeps = 20 or world.iterations = 4"),
        (lambda w: w.hash(1), "1 arguments, but 0 without a name"),
        (lambda w: tv.init(num_threads=4), "write threads="),
        (lambda w: tv.shapes.rope((0, 0), (1, 0), segments=10), "write points. It takes start, end, points"),
        (lambda w: tv.Jacobi(omega=1.5), "It takes relaxation, loads"),
    ],
)
def test_an_argument_of_another_name_is_answered(scene, call, words):
    with pytest.raises(TypeError, match=words):
        call(scene)


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
    "tiverlet.measure": tv.measure, "Collider": tv.Box.__mro__[2], "Shape": tv.shapes.Shape,
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


@pytest.mark.parametrize("name", TERMS)
def test_terms_are_of_others_and_their_answers_exist(name, scene):
    rows = [(names, clause) for owners, rows in ROWS.items() if name in owners.split() for names, clause in rows.items()]
    asked = [one for names, _ in rows for one in names.split()]
    assert len({*asked}) == len(asked) and not {*asked} & names_of(owner(name))  # no name twice, and none that exists
    for _, clause in rows:
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
