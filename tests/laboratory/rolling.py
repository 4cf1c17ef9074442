"""One or two spinning spheres with known answers, beside other engines with the same substeps.

Spheres have k = m r^2 / I = 5/2. They move in a plane, so that 2D engines can be compared.
"""

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tiverlet import Contact, Gravity, HalfSpace, Particles, World
from tiverlet.report.output import Table, error_line

from . import grain_peers

G, K, RADIUS, FRAME = 9.81, 2.5, 0.1, 1 / 60
SUBSTEPS = (5, 20, 80)
PATIENCE = 300.0  # [s] that another engine may take
SMALL = 1e-9  # relative errors below which no order is computed


@dataclass(frozen=True)
class Case:
    """Bodies above the floor y = 0, or without one, and the known answer for the last body.

    x, v: (n, 2) [m, m/s]. omega: (n,) [rad/s]. mass: 0 for a body that cannot move. answer: position (2,), velocity (2,) and
    angular velocity after `seconds`. bounces: whether the case is an impact.
    """

    title: str
    seconds: float
    answer: tuple[np.ndarray, np.ndarray, float]
    x: ArrayLike
    v: ArrayLike
    omega: Sequence[float]
    friction: float
    gravity: tuple[float, float] = (0.0, -G)
    restitution: float = 0.0
    tangential: float = 0.0
    mass: Sequence[float] = (1.0,)
    radius: Sequence[float] = (RADIUS,)
    floor: bool = True
    bounces: bool = False

    def job(self, substeps: int) -> dict:
        """Return the job for grain_peers."""
        names = ("friction", "restitution", "tangential", "floor", "bounces")
        lists = {name: np.asarray(getattr(self, name), dtype=float).tolist() for name in ("x", "v", "omega", "mass", "radius")}
        steps = round(self.seconds / FRAME) * substeps
        h = {"h": FRAME / substeps, "steps": steps, "share": K, "gravity": list(self.gravity)}
        return {name: getattr(self, name) for name in names} | lists | h

    def world(self, precision: str) -> World:
        """Return the case as a World."""
        mass = np.asarray(self.mass)
        start = Particles(
            self.x, velocity=self.v, mass=np.where(mass > 0, mass, 1.0), radius=self.radius, pinned=mass == 0, spin=self.omega,
            inertia="sphere",
        )  # fmt: skip
        law = {"friction": self.friction, "restitution": (self.restitution, self.tangential) if self.bounces else 0.0}
        wall = [HalfSpace((0, 1), **law)] if self.floor else []
        return World(start, [Gravity(self.gravity), *wall, *([Contact(**law)] if len(mass) > 1 else [])], precision=precision)

    def errors(self, found: Sequence[float]) -> tuple[float, float]:
        """Return the relative errors of velocity (v and r omega) and position. found: (x, y, v_x, v_y, omega).

        They are relative to the speed at the end, and to the distance travelled.
        """
        place, velocity, omega = self.answer
        r = self.radius[-1]
        speed, way = np.hypot(*velocity) + r * abs(omega), np.hypot(*(place - np.asarray(self.x)[-1]))
        off = max(np.hypot(*(np.asarray(found[2:4]) - velocity)), r * abs(found[4] - omega))
        return float(off / speed), float(np.hypot(*(np.asarray(found[:2]) - place)) / way)


def downhill(angle: float, mu: float, seconds: float = 0.5) -> Case:
    """Return the case of a sphere on an incline of `angle` phi [rad].

    It rolls with a = k / (1 + k) g sin phi, omega = -a t / r, if tan phi <= (1 + k) mu. Beyond that it slips with
    a = g (sin phi - mu cos phi), omega = -k mu g cos phi t / r.
    """
    pull, weight = G * np.sin(angle), G * np.cos(angle)
    rolls = np.tan(angle) <= (1 + K) * mu
    a = K / (1 + K) * pull if rolls else pull - mu * weight
    alpha = a if rolls else K * mu * weight
    t = seconds
    answer = np.array([a * t**2 / 2, RADIUS]), np.array([a * t, 0.0]), float(-alpha * t / RADIUS)
    title = f"{'rolls' if rolls else 'slips'} down {np.degrees(angle):.0f} degrees, friction {mu}"
    return Case(title, t, answer, [(0, RADIUS)], [(0, 0)], [0], mu, gravity=(float(pull), float(-weight)))


def bowled(v0: float = 3.0, mu: float = 0.2, seconds: float = 1.0) -> Case:
    """Return the case of a sphere thrown without spin on a floor.

    It slides until t = v0 / ((1 + k) mu g) and then rolls at k / (1 + k) v0.
    """
    t1, v = v0 / ((1 + K) * mu * G), K / (1 + K) * v0
    x = v0 * t1 - mu * G * t1**2 / 2 + v * (seconds - t1)
    answer = np.array([x, RADIUS]), np.array([v, 0.0]), -v / RADIUS
    return Case("slides, then rolls", seconds, answer, [(0, RADIUS)], [(v0, 0)], [0], mu)


def collision(mu: float, e: float = 0.8, beta: float = 0.0, seconds: float = 0.5) -> Case:
    """Return the case of two spinning spheres that collide (Walton 1993; Foerster et al. 1994).

    The impact reverses the normal velocity, times e, and the tangential velocity of the contact points, times beta. The
    tangential impulse is at most mu times the normal one.
    """
    m, r = np.array([1.0, 2.5]), np.array([0.1, 0.15])
    x, v = np.array([(0.0, 0.0), (0.5, 0.12)]), np.array([(2.0, 0.3), (-1.0, 0.5)])
    omega = np.array([10.0, -20.0])
    d, u = x[0] - x[1], v[0] - v[1]
    a, b, c = u @ u, d @ u, d @ d - r.sum() ** 2
    hit = (-b - np.sqrt(b * b - a * c)) / a
    n = (d + hit * u) / r.sum()
    t = np.array([-n[1], n[0]])
    push = -(1 + e) * (u @ n) / (1 / m).sum()
    slip = u @ t - omega @ r
    grip = -(1 + beta) * slip / ((1 + K) / m).sum()
    sticks = abs(grip) <= mu * push
    grip = np.clip(grip, -mu * push, mu * push)
    after = v[1] - (push * n + grip * t) / m[1]
    spin = float(omega[1] - grip * K / (m[1] * r[1]))
    answer = x[1] + hit * v[1] + (seconds - hit) * after, after, spin
    how = "grip" if sticks else "slip"
    title = f"two that collide and {how}, friction {mu}, restitution ({e}, {beta})"
    return Case(
        title, seconds, answer, x, v, omega.tolist(), mu, gravity=(0.0, 0.0), restitution=e, tangential=beta, mass=m.tolist(),
        radius=r.tolist(), floor=False, bounces=True,
    )  # fmt: skip


def super_ball(bounces: int = 3, height: float = 0.5, v: float = 2.0) -> Case:
    """Return the case of a super ball, with normal and tangential restitution 1 (Garwin 1969).

    Each bounce reverses v + r omega, by a change of v of 2 / (1 + k) of it. So the second bounce undoes the first.
    """
    fall = np.sqrt(2 * height / G)
    spin, x, left = 0.0, fall * v, 0.0
    seconds = round((2 * bounces * fall) / FRAME) * FRAME
    for k in range(bounces):
        change = -2 * (v + RADIUS * spin) / (1 + K)
        v, spin = v + change, spin + K * change / RADIUS
        left = seconds - (2 * k + 1) * fall
        x += v * min(2 * fall, left)
    up = np.sqrt(2 * G * height)
    answer = np.array([x, RADIUS + up * left - G * left**2 / 2]), np.array([v, up - G * left]), spin
    return Case(
        f"a super ball bounces {bounces} times", seconds, answer, [(0, RADIUS + height)], [(2.0, 0)], [0], 1e3, restitution=1.0,
        tangential=1.0, bounces=True,
    )  # fmt: skip


def from_another(seconds: float = 0.5, theta: float = 0.3) -> Case:
    """Return the case of a sphere that rolls off a larger one.

    (1 + 1 / k) (R + r) theta'' = g sin theta, solved by Runge and Kutta in 2000 steps.
    """
    R, r, steps = 1.0, 0.2, 2000
    h, y = seconds / steps, np.array([theta, 0.0])

    def rate(y):
        """Return theta' and theta''."""
        return np.array([y[1], G * np.sin(y[0]) / ((R + r) * (1 + 1 / K))])

    def place(angle):
        """Return the position of the center at an angle."""
        return (R + r) * np.array([np.sin(angle), np.cos(angle)])

    for _ in range(steps):
        a = rate(y)
        b = rate(y + h / 2 * a)
        c = rate(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
    velocity = (R + r) * y[1] * np.array([np.cos(y[0]), -np.sin(y[0])])
    answer = place(y[0]), velocity, float(-y[1] * (R + r) / r)
    x = np.array([(0.0, 0.0), tuple(place(theta))])
    return Case(
        "rolls off another", seconds, answer, x, np.zeros((2, 2)), [0, 0], 5.0, mass=[0.0, 1.0],
        radius=[R, r], floor=False,
    )  # fmt: skip


def cases() -> list[Case]:
    """Return all cases."""
    return [
        downhill(np.radians(30), 0.3), downhill(np.radians(55), 0.3), bowled(), from_another(), collision(0.1), collision(1.0),
        collision(1.0, beta=0.5), super_ball(),
    ]  # fmt: skip


def own_errors(case: Case, precision: str, substeps: Iterable[int] = SUBSTEPS) -> list[tuple[float, float]]:
    """Return the errors of tiverlet in velocity and position, for each number of substeps."""
    out = []
    with case.world(precision) as world:
        p = world.particles
        for n in substeps:
            world.position, world.velocity, world.spin, world.substeps = p.position, p.velocity, case.omega, n
            world.run(case.seconds)
            out.append(case.errors([*world.position[-1], *world.velocity[-1], world.spin[-1]]))
    return out


def run_engine(engine: str, pythons: Sequence[str], jobs: list[dict]) -> list | str:
    """Return the answers of grain_peers by the first Python that has the engine, or why there are none."""
    why = "not installed"
    for python in pythons:
        command = [python, "-P", str(Path(grain_peers.__file__)), engine]
        try:
            done = subprocess.run(command, input=json.dumps(jobs), capture_output=True, text=True, timeout=PATIENCE)
            done.check_returncode()
        except (OSError, subprocess.SubprocessError) as error:
            why = error_line(error)
            continue
        answers = json.loads(done.stdout)
        if not isinstance(answers[0], str) or not answers[0].startswith("not installed"):
            return answers
    return why


def order(errors: Sequence[float], substeps: Sequence[int] = SUBSTEPS) -> str:
    """Return the order by least squares as text; empty unless all errors are above rounding and fall."""
    if len(errors) < len(substeps) or not (np.diff(errors) < 0).all() or min(errors) < SMALL:
        return ""
    return f"{-np.polyfit(np.log(substeps), np.log(errors), 1)[0]:.1f}"


def main(args) -> Iterator[Table]:
    """Yield a table for each case: relative errors of velocity and position by substeps, and their orders."""
    given, pythons = cases(), (sys.executable, *args.pythons)
    found: dict[str, list] = {f"tiverlet, {p}": [own_errors(case, p) for case in given] for p in ("f32", "f64")}
    for engine in grain_peers.ENGINES:
        answers = run_engine(engine, pythons, [case.job(n) for case in given for n in SUBSTEPS])
        if isinstance(answers, str):
            found[engine] = [[answers]] * len(given)
            continue
        parts = [answers[k : k + len(SUBSTEPS)] for k in range(0, len(answers), len(SUBSTEPS))]
        found[engine] = [
            [a if isinstance(a, str) else case.errors(a[-1]) for a in part] for case, part in zip(given, parts, strict=True)
        ]
    heads = ("substeps", *(f"{what}, {n}" for what in ("velocity", "place") for n in SUBSTEPS), "orders")
    note = "relative errors of velocity, spin included, and of place"
    for k, case in enumerate(given):
        rows = []
        for name, errors in ((name, some[k]) for name, some in found.items()):
            numbers = [e for e in errors if not isinstance(e, str)]
            cells, orders = [] if numbers else [errors[0]], []
            for column in zip(*numbers, strict=True):
                cells += [f"{error:.0e}" for error in column] + ["-"] * (len(SUBSTEPS) - len(numbers))
                orders.append(order(column) or "-")
            rows.append([name, *cells, *[""] * (2 * len(SUBSTEPS) - len(cells)), ", ".join(orders)])
        yield Table(case.title, heads, rows, [note])
