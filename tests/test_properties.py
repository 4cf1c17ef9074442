"""What every constraint of one number must do, tested for all at once: a new constraint is one row of ROWS in rows.py.

All rows of one dimension are in one world. Each has many blocks of the same corners, which test something else; none touch.
"""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet import constraints

from .conftest import order, rms, unprojected
from .rows import OTHERS, PATH, ROWS, Row

BLOCKS = ("met", "off", "turned", "held", "stuck", "soft", "free", "swing", "loaded", "weak")
MASS = np.array([1.0, 2.5, 0.7, 4.0])
STIFF = np.array([0.02, 0.05, 0.1, 0.2, 0.32, 0.5, 0.8, 1.3, 2.0, 5.0, 20.0])  # omega h, about, at 20 substeps
DIMS = pytest.mark.parametrize("dim", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
pytestmark = pytest.mark.usefixtures("briefly")


def at(*names: str) -> list[int]:
    """Return the numbers of blocks."""
    return [BLOCKS.index(name) for name in names]


class Blocks:
    """The blocks of one row. first: the number of their first particle in the world."""

    def __init__(self, row: Row, first: int):
        self.row, (self.arity, self.dim) = row, row.points.shape
        a, k, m = 0.6, self.arity, len(BLOCKS)
        self.turn = np.eye(self.dim)
        self.turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        if self.dim == 3:
            self.turn = np.roll(np.roll(self.turn, 1, axis=0), 1, axis=1) @ self.turn
        self.corners = first + np.arange(m * k).reshape(m, k)
        x, v = np.tile(row.points, (m, 1, 1)), np.zeros((m, k, self.dim))
        x[at("turned")] = x[0] @ self.turn.T + 0.5 * row.internal
        v[at("free", "swing")] = np.random.default_rng(1).normal(size=x[0].shape) * 0.7
        pinned = np.zeros((m, k), dtype=bool)
        pinned[at("held"), 0], pinned[at("stuck")], pinned[at("loaded", "weak"), :-1] = k > 1, True, True
        self.x, self.v, self.mass, self.pinned = (
            x.reshape(-1, self.dim),
            v.reshape(-1, self.dim),
            np.tile(MASS[:k], m),
            pinned.ravel(),
        )
        self.alpha, damping, strength = np.zeros(m), np.zeros(m), np.full(m, np.inf)
        self.alpha[at("soft", "swing", "loaded", "weak")], damping[at("soft")] = [1e-2, 2e-2, 1e-2, 1e-2], 3.0
        strength[at("loaded", "weak")] = np.array([1.1, 0.9]) * abs(row.off) / 10 / 1e-2
        rest = probed(row, self.x, m)[1]
        rest[at("off", "turned", "held", "soft")] -= row.off
        rest[at("loaded", "weak")] -= row.off / 10
        self.feature = row.make(self.corners, rest, compliance=self.alpha, damping=damping, break_at=strength)

    def of(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the rows of `values` of the particles of a block."""
        return values[self.corners[BLOCKS.index(name)]]

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return grad C of the block "off" by central differences of the host's formula, (arity, dim)."""
        out, step, (c,) = np.zeros((self.arity, self.dim)), 1e-6, at("off")
        for k, a in np.ndindex(out.shape):
            move = np.zeros_like(x)
            move[self.corners[c, k], a] = step
            out[k, a] = (self.feature.violation(x + move)[c] - self.feature.violation(x - move)[c]) / (2 * step)
        return out


def probed(row: Row, x: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients and values of f in m blocks of a row, as constraints see them."""
    probe = row.make(np.arange(len(x)).reshape(m, -1), np.zeros(m))
    probe.prepare(tv.Particles(x), np.ones(len(x)))
    return probe.gradients(x), probe.violation(x)


class Zoo:
    """All rows of one dimension in one world."""

    def __init__(self, dim: int):
        self.rows, n = {}, 0
        for name in named(dim):
            self.rows[name] = Blocks(ROWS[name], n)
            n += len(self.rows[name].x)
        each = self.rows.values()
        self.x, self.v, mass, pinned = (np.concatenate([vars(b)[key] for b in each]) for key in ("x", "v", "mass", "pinned"))
        start = tv.Particles(self.x, velocity=self.v, mass=mass, pinned=pinned)
        self.world = built(start, [b.feature for b in each])

    def again(self, substeps: int = 1, iterations: int = 1, world: tv.World | None = None) -> tv.World:
        """Put everything back to the start, without moving what violates constraints there."""
        w = world or self.world
        w.velocity, w.position, w.substeps, w.iterations = self.v, self.x, substeps, iterations
        return unprojected(w)


def named(dim: int) -> list[str]:
    """Return the names of the rows of a dimension."""
    return [name for name, row in ROWS.items() if row.points.shape[1] == dim]


def built(start: tv.Particles, features: list) -> tv.World:
    """Return a world: of all rows, one structure for all tests."""
    return tv.World(
        start, [tv.Gravity(np.zeros(start.dim)), *features], substeps=1, precision="f64", solver=tv.Jacobi(), path="fused"
    )


@pytest.fixture(scope="module")
def zoo(taichi):
    made: dict[int, Zoo] = {}

    def of(dim: int) -> Zoo:
        if dim not in made:
            made[dim] = Zoo(dim)
        return made[dim]

    yield of
    for z in made.values():
        z.world.close()


@DIMS
def test_one_pass_moves_corners_as_newton_says(zoo, dim):
    # From rest: no displacement where C = 0 or all corners are held; elsewhere -w grad C times C / sum w |grad C|^2.
    z = zoo(dim)
    z.again().step(1e-2)
    move = z.world.position - z.x
    for name, b in z.rows.items():
        assert np.abs(b.of("met", move)).max() <= 1e-15 and (b.of("stuck", move) == 0).all(), name
        g, free = b.gradient(z.x), ((np.arange(b.arity) > 0) | (b.arity == 1))[:, None]
        for block, inverse in (("off", 1 / MASS[: b.arity, None]), ("held", free / MASS[: b.arity, None])):
            want = -inverse * g * b.row.off / (inverse * g**2).sum()
            np.testing.assert_allclose(b.of(block, move), want, atol=1e-7 * np.abs(want).max(), err_msg=name)
        assert b.arity == 1 or (b.of("held", move)[0] == 0).all(), name


@DIMS
def test_passes_leave_ever_less_and_residuals_tell_what(zoo, dim):
    z, (c,) = zoo(dim), at("off")
    left = {name: [abs(b.row.off)] for name, b in z.rows.items()}
    for iterations in (1, 2, 4, 8):
        z.again(iterations=iterations).step(1e-2)
        for name, b in z.rows.items():
            f = b.feature
            left[name].append(abs(f.violation(z.world.position)[c]))
            if name in ("Bend 2D", "Volume 3D"):  # reading the residual of each would compile for a quarter of a second
                size = f.quantity.unit or abs(f.rest[c])
                assert f.residual[c] * size == pytest.approx(left[name][-1], rel=1e-6, abs=1e-12), name
    for name, b in z.rows.items():
        assert (np.diff(left[name]) <= 1e-15).all() and left[name][-1] <= 1e-3 * abs(b.row.off), name


@DIMS
def test_momentum_is_constant_and_directions_do_not_matter(zoo, dim):
    # To rounding, for three passes, that of velocities and its moment; and what starts turned and moved stays so. The function of
    # a user has gradients by differences, right to eps^(2/3) = 4e-11 of an impulse, which is a moment: one for each pass.
    z = zoo(dim)
    w, seen = z.again(iterations=3), {name: [] for name in z.rows}
    for _ in range(20):
        w.step(1e-2)
        x, v = w.position, w.velocity
        for name, b in z.rows.items():
            m = MASS[: b.arity, None]
            parts = [(m * b.of(f, v), tv.measure.moment_sum(b.of(f, x), m * b.of(f, v))) for f in ("free", "swing")]
            seen[name].append(np.concatenate([np.r_[p.sum(axis=0), moment] for p, moment in parts]) * 1e-2)
            turned = b.of("off", x) @ b.turn.T + 0.5 * b.row.internal
            np.testing.assert_allclose(b.of("turned", x), turned, atol=1e-11, err_msg=name)
            assert (b.of("stuck", x) == b.of("stuck", z.x)).all(), name
    for name, b in z.rows.items():
        digit = 3 * 4e-11 if isinstance(b.feature, tv.Constraint) else 20 * 1e-15
        assert not b.row.internal or np.ptp(seen[name], axis=0).max() <= digit * np.abs(seen[name]).max(), name


@DIMS
def test_rigid_and_soft_converge_with_the_square_of_the_substep(zoo, dim):
    z, ends = zoo(dim), []
    for substeps in (10, 20, 40, 80):
        z.again(substeps, 8).run(0.3, dt=0.1)
        ends.append(z.world.position)
    for name, b in z.rows.items():
        for block in ("free", "swing") if b.row.bilateral else ():
            steps = [rms(b.of(block, x), b.of(block, y)) for x, y in zip(ends[1:], ends[:-1], strict=True)]
            assert 1.9 <= order(steps) <= 2.1, (name, block, steps)


@DIMS
def test_springs_bear_their_load_and_weak_ones_break(zoo, dim):
    # Of two equal springs one is too weak for its load, and breaks before the first frame ends. Under a load F along grad_k f the
    # other gives way by alpha F / |grad_k f|: there it is in balance, and reports F; velocities count it as a force, too.
    z, (c,) = zoo(dim), at("loaded")
    z.again().step(1e-2)
    for k, (name, b) in enumerate(z.rows.items()):
        assert np.flatnonzero(b.feature.broken).tolist() == [c + 1] and b.feature.load[c + 1] == 0, name
        want = b.row.off / 10 / b.alpha[c]
        with z.world.clone() as w:
            w.features[0].g = want * b.gradient(z.x)[-1] / MASS[b.arity - 1]
            z.again(20, 4, w).run(0.5, dt=0.1)
            np.testing.assert_allclose(b.of("loaded", w.position), b.of("loaded", z.x), atol=2e-7, err_msg=name)
            np.testing.assert_allclose(b.of("loaded", w.velocity), 0.0, atol=1e-8, err_msg=name)
            assert w.features[1 + k].load[c] == pytest.approx(want, rel=1e-5), name


def springs(row: Row, first: int) -> tuple:
    """Return positions, velocities and a feature: blocks that move, as stiff as STIFF, and two at rest, rigid and damped."""
    m, k = len(STIFF) + 2, len(row.points)
    x = np.tile(row.points, (m, 1))
    v = np.tile(0.02 * np.random.default_rng(5).normal(size=row.points.shape), (m, 1))
    v[-2 * k :] = 0
    slopes, rest = probed(row, x, m)
    if row.bilateral:  # one-sided constraints just touch
        rest[:-2] -= 0.1 * row.off
    alpha = np.append((slopes**2).reshape(m, -1).sum(axis=1)[:-2] / (1200 * STIFF) ** 2, [0.0, 1e-2])
    corners, damping = first + np.arange(m * k).reshape(m, k), np.append(np.zeros(m - 1), 3.0)
    return x, v, row.make(corners, rest, compliance=alpha, damping=damping, break_at=1e9)


@DIMS
def test_starts_from_velocities_that_were_read_change_nothing(dim):
    # Without gravity a block has the energy of its start. Starts from the velocities that are read, after each frame, may neither
    # pump a spring nor brake it by more than 1 - (1 - (omega h)^4 / 16). With the force of the substep before in them, they would
    # grow by 1 + (omega h)^2 / 4 per frame, e^(15 omega^2 h^2) per second. Assigning what was read makes no start.
    parts, blocks, n = [], [], 0  # blocks: the particles of each moving block
    for name in named(dim):
        parts.append(springs(ROWS[name], n))
        blocks.append(n + np.arange(len(STIFF) * len(ROWS[name].points)).reshape(len(STIFF), -1))
        n += len(parts[-1][0])
    x, v = (np.concatenate([part[k] for part in parts]) for k in range(2))
    mass = np.ones(n)
    for block in blocks:
        mass[block] = MASS[: block.shape[1]]
    start = tv.Particles(x, velocity=v, mass=mass)
    with built(start, [part[2] for part in parts]) as w:

        def kinetic(back):
            w.position, w.velocity = start.position, start.velocity
            out = []
            for _ in range(frames):
                if back:
                    w._start_from(w.velocity)
                w.step(1 / 60)
                each = mass * (w.velocity**2).sum(axis=1)
                out.append([each[block].sum(axis=1) for block in blocks])
            return np.array(out)

        for substeps, frames in (2, 150), (8, 100), (20, 150), (80, 60):
            w.substeps = substeps
            alone, back = kinetic(False), kinetic(True)
            few = frames // 5
            most, first, last = alone.max(axis=0), back[:few].max(axis=0), back[-few:].max(axis=0)
            assert (last <= 1.02 * np.maximum(first, most)).all(), (substeps, last / np.maximum(first, most))
            resolved = STIFF * 20 / substeps < 0.3
            assert (last >= 0.9 * alone[-few:].max(axis=0))[:, resolved].all(), (substeps, last)


def degenerate(row: Row) -> np.ndarray:
    """Return corners in every special position, (blocks, arity, dim)."""
    k, dim = row.points.shape
    line = np.arange(k)[:, None] * np.eye(dim)[0]
    pair, last, folded, flat = row.points.copy(), row.points.copy(), line.copy(), row.points.copy()
    pair[-1], last[k // 2], folded[-1], flat[:, -1] = pair[0], last[-1], line[0] + 0.3 * np.eye(dim)[0], 0
    cases = [0 * line, 0 * line + 7.3, line, -line, folded, pair, last, flat, row.points + 1e6, row.points - 1e12]
    return np.stack(cases + [row.points * s for s in (1e-30, 1e-20, 1e-13, 1e-11, 1e-6, 1e6, 1e14) if s < row.largest])


@DIMS
def test_nothing_explodes_where_a_constraint_has_no_direction(world, dim):
    # Rows 15, 17, 54, 56: no NaN, and no particle moves further than its corners are apart, or than the constraint demands. In 3D
    # in f32; in 2D with the kernels of the tests above.
    blocks, features, rests, n = {}, {}, {}, 0
    for name in [name for name in named(dim) if name != "AngleLimit 3D"]:  # which is as Bend 3D
        row = ROWS[name]
        k, x = len(row.points), np.concatenate([degenerate(row)] * 2)
        rests[name], alpha = float(probed(row, row.points, 1)[1][0]) - row.off, np.repeat([0.0, 1e-3], len(x) // 2)
        corners, more = n + np.arange(len(x) * k).reshape(-1, k), {"damping": np.where(alpha > 0, 1e-3, 0)}
        more |= {"break_at": 1e300} if dim == 2 else {}
        features[name] = row.make(corners, np.full(len(x), rests[name]), compliance=alpha, **more)
        blocks[name] = (corners, x)
        n += len(x) * k
    start = tv.Particles(np.concatenate([x.reshape(-1, dim) for _, x in blocks.values()]))
    made = list(features.values())
    w = built(start, made) if dim == 2 else world(start, made, substeps=1, path="fused")
    w.iterations = 3
    for frame in range(20):
        report = w.step(1 / 60)
        assert "non-finite" not in report.flags and np.isfinite([report.residual, report.energy]).all()
        assert all(np.isfinite(f.load).all() for f in made)
        for name, (corners, x) in blocks.items() if frame == 0 else ():  # later, what a violent correction has moved flies on
            size = 0 if ROWS[name].internal else np.abs(x).max(axis=(1, 2))
            size = size + (0 if features[name].quantity.unit else abs(rests[name]))
            size = size + np.ptp(x, axis=1).max(axis=1) + 1e-6 * np.abs(x).max(axis=(1, 2))
            moved = np.abs(w.position[corners] - x).max(axis=(1, 2))
            assert (moved <= 5 * size).all(), (name, np.argmax(moved / (size + 1e-300)), np.c_[moved, size])
    w.close()


@pytest.mark.slow
def test_cells_and_planets_move_as_what_lies_on_a_table(world):
    # Lengths times 2^a, masses times 2^b and accelerations times 2^a give the same bits times 2^a, down to cells of 8 um and
    # 1e-12 kg in f32. There w |grad f|^2 of an angle is 1e22, and a multiplier of a spring 1e-23 kg m, whose squares f32 cannot
    # hold.
    x, found = np.concatenate([PATH, PATH + 2.0]), []
    for length, mass in ((1.0, 1.0), (2.0**-17, 2.0**-40), (2.0**15, 2.0**80)):
        features = [tv.Bend([[0, 1, 2], [3, 4, 5]]), tv.Distance([[0, 1], [4, 5]]), tv.Pin([0, 4], compliance=1e-2 / mass)]
        start = tv.Particles(x * length, velocity=length * np.sin(np.arange(18)).reshape(6, 3), mass=mass)
        w = world(start, [tv.Gravity(9.81 * length), *features], substeps=10, solver=tv.Jacobi())
        reports = [w.step(1 / 60) for _ in range(10)]
        assert all(report.clean for report in reports)
        energies = [[report.residual, report.energy / (mass * length**2)] for report in reports]
        found.append(np.concatenate([w.position / length, np.reshape(energies, (-1, 1)) + np.zeros(3)]))
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_the_tables_hold_every_constraint():
    named = {name.split()[0].rstrip(",") for name in (*ROWS, *OTHERS)}
    assert named == set(constraints.__all__) and all(reason for *_, reason in OTHERS.values())
