"""Errors for invalid arguments: they say what is wrong, with index and value, before Taichi is called."""

import copy
import pickle

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.language import COMPILER
from tiverlet.report.stress.certificate import PASSED, certify

from .conftest import python

NAN = float("nan")


def particles(**kwargs):
    return lambda: tv.Particles(np.arange(8.0).reshape(4, 2), **kwargs)


def scene(*features, **kwargs):
    return lambda: tv.World(tv.Particles(np.arange(8.0).reshape(4, 2), radius=0.1), features, **kwargs)


@pytest.mark.parametrize("row", [3, 5, 10, 13, 19, 20, 26, 49, 63, 64, 66, 87])
def test_rows_of_the_certificate_name_what_they_refuse(row):
    # Masses, radii, compliances, lengths, indices, NaN, solvers, frames; CI runs the others, too: tiverlet stress.
    assert certify(row).verdict == PASSED


@pytest.mark.parametrize("name", ["velocity", "mass", "radius", "pinned", "group", "spin", "inertia", "orientation"])
@pytest.mark.parametrize("wrong", [np.ones((7, 7)), [[0], [1, 2]], NAN, "x"], ids=["shape", "ragged", "nan", "text"])
def test_arguments_of_particles_are_named_where_they_are_wrong(name, wrong):
    # test_knobs.py does the same with what can be set of forces, constraints and walls.
    given = {"spin": 0.0} if name in ("inertia", "orientation") else {}
    with pytest.raises((ValueError, TypeError), match=f"Particles: {name}"):
        tv.Particles(np.arange(8.0).reshape(4, 2), **{"radius": 1.0} | given | {name: wrong})


@pytest.mark.parametrize(
    "make, error, words",
    [
        # particles
        (particles(velocity=3.0), ValueError, "no direction"),
        (particles(pinned=[4]), ValueError, r"pinned\[0\] = 4, but there are 4 particles \(0 ... 3\)"),
        (particles(pinned=[True, False]), ValueError, r"mask of shape \(4,\)"),
        (lambda: tv.Particles([[0, 0], [1]]), ValueError, "ragged"),
        (lambda: tv.Particles(np.zeros((3, 4))), ValueError, r"\(3, 4\), but \(n, 2\) or \(n, 3\)"),
        (lambda: tv.Particles([["a", "b"]]), TypeError, "real numbers"),
        (lambda: tv.Particles([[0, 1e19]]), ValueError, r"position\[0, 1\] = 1e\+19 m is out of range"),  # row 29
        # links
        (scene(tv.Distance([[0, 1]], compliance=0.0), "gravity"), TypeError, r"features\[1\] = 'gravity'"),
        (scene(tv.Gravity), TypeError, r"write Gravity\(...\)"),
        (scene(tv.Distance([[0, 1]]), tv.Pin([2]), tv.Pin([1, 2])), ValueError, r"\[2\] = Pin holds particle 2, .* features\[1"),
        (scene(tv.Path([2], [(0, 0), (1, 0)], speed=1), tv.Pin([2], compliance=1)), ValueError, r"held by features\[0\] = Path"),
        (lambda: tv.World(tv.Particles([[0, 0]], pinned=[0]), [tv.Pin([0])]), ValueError, "particle 0, which is pinned"),
        (lambda: tv.Polygons(1), TypeError, "loops = 1 is a int, but a sequence of index sequences"),
        (lambda: tv.Polygons([0, 1, 2]), TypeError, r"is one body; write a list of bodies"),
        (lambda: tv.Distance([0, 1]), ValueError, r"shape \(2,\), but \(m, 2\)"),
        (lambda: tv.Distance(tv.shapes.rope((0, 0), (1, 0), 5)), TypeError, r"pairs is a Shape, .* write shape.links"),
        (lambda: tv.Particles(tv.shapes.rope((0, 0), (1, 0), 5)), TypeError, r"position is a Shape, .* write shape.position"),
        (lambda: tv.Ball(1.0, (0, 0)), ValueError, r"center has shape \(\), but 2 numbers are needed in 2D, 3 in 3D"),
        (lambda: tv.World(tv.Particles([[0.0, 0]])).remove([tv.Gravity()]), TypeError, r"write features=\[...\]"),
        (lambda: tv.Worlds(tv.World(tv.Particles([[0.0, 0]])), 2)[2], IndexError, r"world 2, but there are 2 \(0 ... 1\)"),
        (lambda: tv.golden(5, dim=0), ValueError, "dim = 0, but it must be at least 1"),
        (lambda: tv.golden_colors(-1), ValueError, "count = -1"),
        (lambda: tv.Distance([[0.5, 1]]), TypeError, "integers"),
        (lambda: tv.Distance([[0, 1]], damping=[-1.0]), ValueError, r"damping\[0\] = -1"),
        (lambda: tv.Distance([[0, 1]], break_at=0.0), ValueError, r"break_at\[0\] = 0, but it must be above 0"),
        (lambda: tv.Pin([0, 0]), ValueError, "named twice"),
        (lambda: tv.Pin([0, 1], compliance=[0, 1]), ValueError, r"compliance\[0\] = 0 among positive"),
        (scene(tv.Pin([7])), ValueError, r"indices\[0\] = 7"),
        # walls, forces, contacts
        (lambda: tv.Box((0, 0), (1, -1)), ValueError, "along axis 1 it goes from 0 to -1"),
        (scene(tv.Box((0, 0, 0), (1, 1, 1))), ValueError, "2 numbers are needed in a 2D world"),
        (lambda: tv.HalfSpace((0, 0)), ValueError, "no direction"),
        (lambda: tv.Gravity(-9.81), ValueError, r"g = -9.81, .* along -y: write 9.81, or \(0, 9.81\) for gravity that pulls up"),
        (particles(spin=False, radius=1.0, orientation=0.0), ValueError, "spin = False, but orientation is for particles that"),
        (lambda: tv.Force(lambda x: x), TypeError, "@ti.func"),
        (lambda: tv.Contact(skin=0), ValueError, "skin = 0, but it must be above 0"),
        (lambda: tv.Contact(friction=(0.2, 0.5)), ValueError, "must not exceed"),
        (lambda: tv.Contact(friction={(0, 1): 0.5, (1, 0): 0.1}), ValueError, "two values"),
        (scene(tv.Contact(), tv.Contact()), ValueError, "more than one Contact"),
        # world
        (lambda: tv.World(tv.Particles([[0.0, 0]]), tv.Gravity()), TypeError, r"features = Gravity is a Gravity; write a list"),
        (lambda: tv.Recorder(tv.World(tv.Particles([[0.0, 0]])), "x.rrd"), TypeError, r"write tv.Recorder\(path, world\)"),
        (lambda: tv.Particles(np.ma.array([[0.0, 1.0]], mask=[[True, False]])), ValueError, "position has masked values"),
        (lambda: pickle.dumps(tv.World(tv.Particles([[0.0, 0]]))), TypeError, r"Use world.clone\(\)"),
        (lambda: tv.World(tv.Particles([[0.0, 0]])).run(1, recorder=3), TypeError, r"recorder = 3 is a int, but a path or a "),
        (scene(substeps=True), TypeError, "substeps = True"),
        (scene(precision="f16"), ValueError, "precision = 'f16', but it must be one of 'f32'"),
        (scene(path="fast"), ValueError, "path = 'fast'"),
        (lambda: tv.World(np.zeros((3, 2))), TypeError, r"use tv.Particles\(position\)"),
        (lambda: tv.World(tv.shapes.rope((0, 0), (1, 0), 5)), TypeError, r"is a Shape; write tv.Particles\(shape.position\)"),
        (lambda: tv.Distance([[0, 1]], rest=1e30), ValueError, r"rest\[0\] = 1e\+30, but it must be at most 1e\+15"),
        (lambda: tv.shapes.rope((0, 0), (1, 0), 5).turned(90), ValueError, r"write np.radians\(90\)"),
        (lambda: tv.Jacobi(relaxation=0), ValueError, "above 0"),
        (lambda: tv.init(arch="gpu"), ValueError, "arch = 'gpu', but it must be one of 'cpu'"),
        (lambda: tv.init(threads=0), ValueError, "threads = 0"),
        (lambda: tv.init(threads=np.float64(2)), ValueError, "but it must be an integer of at least 1"),
        (lambda: tv.measure.center_of_mass(tv.World(tv.Particles([[0.0, 0]], pinned=[0]))), ValueError, "no particle can move"),
        (lambda: tv.shapes.rope((0, 0), (1, 0), points=1), ValueError, "points = 1"),
        (lambda: tv.shapes.cloth((0, 0), (1, 0), (0, 1), 10), ValueError, r"points = 10, .*: \(10, 10\)"),
    ],
)  # fmt: skip
def test_bad_input_is_named(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize("size", [1e200, 1e-200])  # whose squares are infinite, or 0
def test_a_direction_has_any_length(size):
    np.testing.assert_array_equal(tv.HalfSpace((size, 0)).normal, [1, 0])
    np.testing.assert_array_equal(tv.Capsule((0, 0), (1, 0), 0.1, one_way=(0, -size)).one_way, [0, -1])


def test_the_softest_spring_does_nothing(world):
    # x = v t + g t^2 / 2. compliance / h^2 is finite in f32, and h^2 F is 0, for h of a microsecond.
    link, x = tv.Distance([[0, 1]], 0.5, compliance=1e24), np.array([[0.0, 0.0], [1.0, 0.0]])
    w = world(tv.Particles(x, velocity=(1.0, 0.0)), [tv.Gravity(9.81), link], substeps=1)
    for _ in range(3):
        report = w.step(1e-6)
    np.testing.assert_allclose(w.position, x + [3e-6, 0], rtol=0, atol=1e-7)
    assert np.isfinite(report.energy) and report.clean and np.abs(link.load).max() < 1e-20


def test_structure_is_fixed_and_says_so(world):
    p = tv.Particles([[0.0, 1.0]], mass=2.0)
    link = tv.Distance([[0, 1]])
    w = world(tv.Particles([[0.0, 1.0], [1, 1]]), [link])
    with pytest.raises(AttributeError, match="structure, fixed when a world is built"):
        p.mass = 3.0
    for array in (p.mass, p.radius, p.position, link.indices, link.compliance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(AttributeError, match="World.time cannot be set"):
        w.time = 3.0
    with pytest.raises(AttributeError, match="World.gravity cannot be set"):
        w.gravity = 3.0
    for dt in ("1", None, True):
        with pytest.raises(TypeError, match="dt"):
            w.step(dt)
    with pytest.raises(ValueError, match="listed twice"):
        g = tv.Gravity()
        tv.World(p, [g, g])
    with pytest.raises(TypeError, match="gravity cannot be changed"):
        w.clone(gravity=1)


@pytest.mark.slow
def test_features_of_a_world_are_pickled_and_copied_without_it(world):
    start, pairs = tv.Particles([[0.0, 0.0], [1.0, 0.0]], radius=0.1), [[0, 1]]
    features = [tv.Gravity(3.0), tv.Distance(pairs, 2.0, compliance=0.1), tv.HalfSpace((0, 1), friction=0.2)]
    w = world(start, features)
    w.step(0.1)
    for others in (pickle.loads(pickle.dumps(features)), copy.deepcopy(features)):
        again = world(start, others)
        again.step(0.1)
        assert again.hash() == w.hash() and all(a is not b for a, b in zip(features, others, strict=True))


def test_features_without_effect_are_warned_of(world):
    start = tv.Particles([[0.0, 0], [1, 0], [3.5, 0]])
    with pytest.warns(UserWarning, match="friction = 30 is a coefficient. Of a slope of 30 degrees it is 0.58"):
        tv.Contact(friction=30)
    with pytest.warns(UserWarning, match="dt = 60 is a frame of 60 s. For 60 frames a second write dt=1/60"):
        world(start, []).step(60)
    with pytest.warns(UserWarning, match="all radii are 0, so nothing touches"):
        world(start, [tv.Contact()])
    with pytest.warns(UserWarning, match=r"particle 2 starts 1.5 m outside along axis 0 \(1 such in all\); push_out brings"):
        world(start, [tv.Box((-2, -2), (2, 2))])
    world(start, [tv.Box((-2, -2), (2, 2), active=False)])  # an inactive box has no inside


@ti.func
def flat(x):
    return -x[0]


@ti.func
def deep(x, v):
    return ti.Vector([0.0, 0.0, 1.0])


@ti.func
def silent(x):
    y = 2 * x  # noqa: F841


@ti.func
def branching(x):
    if x[0] > 0:
        return x
    return -x


def one_vector(a, b):
    return a - b


def distance(a, b):
    return (a - b).norm()


@ti.func
def misordered(x, t):
    return x * t


@ti.func
def five(a, b, c, d, e):
    return a


LINK = [[0, 1]]


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: tv.Force(flat), "flat returns a number, but in 2D a force has 2 components"),
        (lambda: tv.Force(deep), "deep returns 3 components, but in 2D a force has 2 components"),
        (lambda: tv.Force(five), "must take 1 to 4 of"),
        (lambda: tv.Force(silent), "Force: silent returns nothing"),
        (lambda: tv.PairForce(deep, potential=deep), "takes .'x', 'v'., but it must take 1 or 3 of .r, i, j.,"),
        (lambda: tv.PairForce(silent, potential=flat), "silent returns nothing"),
        (lambda: tv.Sdf(silent), "Sdf: silent returns nothing, but it must return one number"),
        (lambda: tv.Sdf(flat, gradient=flat), "Sdf: flat returns a number, but in 2D a gradient has 2 components"),
        (lambda: tv.Constraint(one_vector, LINK), r"Constraint\(one_vector\): one_vector returns 2 components"),
        (lambda: tv.Constraint(distance, LINK, gradient=one_vector), "one_vector must return 2 vectors, the gradient by each"),
        (lambda: tv.Force(misordered), "takes .'x', 't'.*: its t would get v"),
    ],
)
def test_functions_of_users_with_wrong_arguments_or_results_are_named(make, words):
    # A vector in place of the value of an Sdf ended the process; a matrix or a vector elsewhere gave an error inside of Taichi.
    with pytest.raises(TypeError, match=words):
        w = tv.World(tv.Particles([[1.0, 1.0], [2.0, 1.0]]), [make()])
        with pytest.raises(TypeError, match=words):
            w.step(0.1)
        w.step(0.1)  # every step raises the error


def test_errors_in_functions_of_users_name_their_line(world):
    with pytest.raises(Exception) as caught:
        world(tv.Particles([[0.0, 1.0]]), [tv.Force(branching)]).step(0.1)
    said = str(caught.value)
    assert said.startswith("branching cannot be compiled:\nFile") and "test_checks.py" in said and "return x\n" in said
    assert "integrator.py" not in said and "A Taichi function returns once, at its end" in said


def test_errors_before_a_start_name_tv_init():
    typed = (
        f"import {COMPILER} as ti\nimport tiverlet as tv\n"
        "for make in (lambda: ti.field(ti.f32, 4), lambda: ti.Vector.field(2, ti.f32, 4)):\n"
        "    try:\n        make()\n    except RuntimeError as e:\n        print(e)\n"
        "space = {'ti': ti}\nexec('@ti.func\\ndef f(x):\\n    return -x', space)\n"
        "try:\n    tv.Force(space['f'])\nexcept ValueError as e:\n    print(e)\n"
        "tv.World(tv.Particles([[0.0, 0.0]]))\n"
    )
    done = python(typed, TI_LOG_LEVEL="")
    said = done.stdout.splitlines()
    words = "Call tv.init() first" if COMPILER == "taichi" else "forgot to call `qd.init()` first"  # its check comes first
    assert sum(words in line for line in said) == 2 and "in a file or in a notebook" in said[-1]
    assert "overridden" not in done.stdout + done.stderr


def test_held_and_driven_constraints_have_no_residual_and_no_load(world):
    x = np.arange(10.0).reshape(5, 2)
    held, pin = tv.Distance([[0, 1]], rest=2**1.5, break_at=1.0), tv.Pin([2])
    snap, path = tv.Snap([1], 1.0, compliance=1.0), tv.Path([3], [(6, 7), (9, 7)], speed=1.0)
    w = world(tv.Particles(x, pinned=[0, 1]), [tv.Gravity(), held, pin, path, snap])
    for f in (held, pin, path, snap):
        with pytest.raises(ValueError, match="already acts in another world"):
            world(w.particles, [f])
    w.step(1 / 60)
    for f in (held, pin, path, snap):
        assert f.residual.tolist() == [0.0]
    assert held.load.tolist() == [0.0] and snap.load.tolist() == [[0.0, 0.0]] and not held.broken.any()
    held.rest = 1.0
    w.step(1 / 60)
    w.close()
    for ask in (lambda: held.load, lambda: held.residual, lambda: w.contacts, lambda: w.broken, w.add, w.hash, w.clone):
        with pytest.raises(RuntimeError):
            ask()


def test_a_world_that_fails_to_build_leaves_its_features_free(world):
    link = tv.Distance([[0, 1]])
    with pytest.raises(ValueError):
        tv.World(tv.Particles([[0.0, 0]]), [link])
    w = world(tv.Particles([[0.0, 0], [1, 0]]), [link])
    w.close()
    world(tv.Particles([[0.0, 0], [1, 0]]), [link]).run(0.05)


def test_warnings_name_the_line_of_the_user():
    # However deep in the package the cause is found, when a world is built and when something is added to it.
    x, off = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 2.0]], [(0, 5), (1, 5)]
    with pytest.warns(UserWarning) as said:
        worlds = [
            tv.World(tv.Particles(x, pinned=[0, 1]), [tv.Distance([[0, 1]], rest=2.0)]),
            tv.World(tv.Particles(x), [tv.Contact()]),
            tv.World(tv.Particles(x), [tv.Path([0], off)]),
            tv.World(tv.Particles(x), [tv.Box((0.0, 0.0), (1.0, 1.0))]),
            tv.World(tv.Particles(x, radius=0.1), [tv.Polygons([[0, 2, 3]])]),
            tv.World(tv.Particles(x), [tv.Distance([[0, 1], [0, 1]])]),
        ]
        worlds[1].add(features=[tv.Path([0], off)])
    for w in worlds:
        w.close()
    assert len(said) >= 7 and {(w.filename, w.category) for w in said} == {(__file__, UserWarning)}
