"""One scene, run and judged: what may never happen in any scene."""

import os
import traceback
import warnings
from collections.abc import Iterable, Iterator

import numpy as np

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, SLOP
from tiverlet.recording.scene import knobs, set_knobs
from tiverlet.step import checkpoint

from . import oracles
from .scenes import Event, Set, Step, Structure

HOME = os.path.dirname(os.path.abspath(tv.__file__))
RISKS = {"tunnelling-risk", "stiff-force", "softened", "turned", "substeps-capped", "stuck", "unconverged", "compressed"}
# Finds that no scene may have. Others are left to campaigns.
HARD = {"error", "nan", "bits", "overlap", "residual", "momentum", "spin", "twin", "wall"}


class Find(AssertionError):
    """A fault, by its kind."""

    def __init__(self, kind: str, says: str):
        super().__init__(f"{kind}: {says}")
        self.kind = kind


class Refused(Exception):
    """An error for invalid arguments, as it should be."""


def quiet() -> None:
    """Silence the package's warnings; turn NumPy's into errors."""
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", RuntimeWarning)


def door(error: BaseException) -> None:
    """Raise Refused for an error that the package raises with a message of its own, else Find.

    Such an error is a ValueError, TypeError or RuntimeError.
    """
    last = traceback.extract_tb(error.__traceback__)[-1]
    ours = os.path.abspath(last.filename).startswith(HOME)
    first = str(error).partition(":")[0].partition("(")[0].partition(".")[0]
    if type(error) in (ValueError, TypeError, RuntimeError) and ours and (hasattr(tv, first) or first == "World"):
        raise Refused(str(error)) from None
    where = "".join(traceback.format_tb(error.__traceback__)[-2:])
    raise Find("error", f"{type(error).__name__}: {str(error)[:300]}\n{where}") from None


class Trial:
    """A world that is compiled once, in which many scenes are run."""

    def __init__(self, structure: Structure):
        self.structure = structure
        try:
            with warnings.catch_warnings():
                quiet()
                self.world, self.features = structure.build()
        except Exception as error:  # noqa: BLE001
            door(error)
        self.begin()

    def begin(self) -> None:
        """Keep the state from which scenes start."""
        w = self.world
        self.kept, self.flags = checkpoint.keep(w), checkpoint.flags(w)
        self.knobs = [dict(knobs(f)) for f in self.features]
        self.free = w._runner.scene.inv_mass.copy()
        self.eps = oracles.EPS[w.precision]

    def close(self) -> None:
        """Free the memory of the world."""
        self.world.close()

    def reset(self) -> None:
        """Restore the world as it was built."""
        w = self.world
        for f, values in zip(self.features, self.knobs, strict=True):
            if any(vars(f)[k] is not v for k, v in values.items()):
                set_knobs(f, values)
        w._rebuild_for_knobs()  # to what the features need: install() is for worlds that were just built
        checkpoint.install(w, self.kept, self.flags)
        w._last = None
        w.substeps, w.iterations = 20, 1

    def frames(self, events: Iterable[Event], kinds: set[str] | None = None) -> Iterator[tv.StepReport]:
        """Run a scene, judge each frame, and yield its report. kinds: of finds to raise, None for all."""
        self.reset()
        w, judge = self.world, Judge(self, kinds)
        for event in events:
            judge.before(event)
            try:
                with warnings.catch_warnings():
                    quiet()
                    out = event.do(w, self.features)
            except Exception as error:  # noqa: BLE001
                door(error)
            if isinstance(event, Step):
                judge.frame(event, out)
                yield out

    def run(self, events: Iterable[Event]) -> str:
        """Run a scene, judge each frame, and return the hash of the final state."""
        for _ in self.frames(events):
            pass
        return self.world.hash()

    def replay(self, events: list[Event]) -> str:
        """Run a scene again without judging it."""
        self.reset()
        for event in events:
            event.do(self.world, self.features)
        return self.world.hash()


class Judge:
    """The record of a scene so far, against which frames are judged."""

    def __init__(self, trial: Trial, kinds: set[str] | None = None):
        self.kinds = kinds
        self.t, self.w, self.p = trial, trial.world, trial.world.particles
        self.x = self.w.position
        self.low, self.high = self.x.min(axis=0, initial=np.inf), self.x.max(axis=0, initial=-np.inf)
        self.passive = oracles.passive(trial.structure) and len(self.x) > 0
        self.closed = oracles.closed(trial.structure) and len(self.x) > 0
        self.energy: float | None = None
        self.flags: set[str] = set()
        self.steps = 0
        self.auto = False
        self.watched = True
        self.safe = self.inside()
        self.rows = any(type(f).__name__ in ("Contact", "Polygons") for f in trial.features)
        self.exact = False  # whether the scene began with its constraints met

    def find(self, kind: str, says: str) -> None:
        """Raise a find, if it is of the kinds that are looked for."""
        if self.kinds is None or kind in self.kinds:
            raise Find(kind, says)

    def inside(self) -> dict[int, np.ndarray]:
        """Return for each wall which particles are outside of it."""
        x = self.w.position
        out = {}
        for k, f in enumerate(() if self.t.structure.periodic else self.t.features):  # walls act on images
            if type(f).__name__ in oracles.WALLS:
                out[k] = (oracles.gap(f, x, self.p.radius) >= 0) & (self.t.free > 0)
        return out

    def before(self, event: Event) -> None:
        """Update the record before an event."""
        if isinstance(event, Set):
            if event.of is None and event.name == "substeps":
                self.auto = event.value == "auto"
            if event.of is not None or (self.steps and event.name in ("position", "velocity")):
                self.passive = self.closed = False
                if len(self.safe) > 1:  # moved walls may leave no place between them
                    self.watched = False
            if event.name == "position":
                self.safe = {}
        elif isinstance(event, Step) and self.steps == 0:
            self.x = self.w.position
            self.safe = self.inside()
            self.exact = oracles.feasible(self.t.features, self.p, self.t.free, self.x, self.t.eps)
            self.passive = self.passive and self.exact
            if self.closed:
                self.v = self.w.velocity
                self.spin = oracles.spin(self.p.mass, self.x, self.v)
        elif isinstance(event, Step) and not self.safe:
            self.safe = self.inside()

    def frame(self, event: Step, report: tv.StepReport) -> None:
        """Judge a frame."""
        x = self.w.position
        self.steps += 1
        self.flags |= report.flags
        bad = ~np.isfinite(x).all(axis=1)
        if bad.any() and not {"non-finite"} & report.flags:
            self.find("nan", f"particle {int(np.argmax(bad))} is {x[bad][0]}, flags {set(report.flags)}")
        figures = [report.energy, report.residual, report.overlap, report.tension]
        if not np.isfinite(figures).all() and not {"non-finite", "out-of-range"} & self.flags:
            self.find("nan", f"figures {figures} of finite positions, flags {set(report.flags)}")
        if {"non-finite", "out-of-range"} & self.flags:
            self.passive = self.closed = False
            self.safe = {}
            return
        self.low, self.high = (
            np.minimum(self.low, x.min(axis=0, initial=np.inf)),
            np.maximum(self.high, x.max(axis=0, initial=-np.inf)),
        )
        self.bounded(report)
        self.figures(report, x)
        self.walls(x)
        self.momentum(event, x)
        self.x = x

    def bounded(self, report: tv.StepReport) -> None:
        """Check that a passive scene gains no more than a thousandth of its energy or of m g L, its size or its way.

        Where "auto" chooses the substeps, it is a fiftieth: it repeats frames whose energy is wrong by that.
        """
        if self.energy is None:
            self.energy = report.energy - report.energy_change
            if not np.isfinite(self.energy):
                self.passive = False
            x = self.x
            self.low, self.high = np.minimum(self.low, x.min(axis=0)), np.maximum(self.high, x.max(axis=0))
        if not self.passive:
            return
        t = self.t
        reach = np.maximum(self.high - self.low, self.p.size)
        fall = oracles.height(t.features, self.p, t.free, self.low, self.low + reach)
        flagged = bool(self.flags & RISKS)  # a flagged frame may be wrong, but must not explode
        share = 1.0 if flagged else 0.02 if self.auto else 1e-3
        room = share * max(fall, abs(self.energy)) + self.digits(fall)
        if "energy-gain" in report.flags and report.energy <= self.energy + room:
            self.find("energy-gain", f"{self.energy:.6g} -> {report.energy:.6g} J; {set(self.flags)}, {report}")
        if report.energy > self.energy + room:
            kind = "energy, flagged" if flagged else "energy"
            self.find(kind, f"{self.energy:.6g} -> {report.energy:.6g} J, allowed {room:.3g} more; {set(self.flags)}, {report}")

    def digits(self, fall: float) -> float:
        """Return how much energy [J] rounding of coordinates may add: in heights, steps h = dt / substeps, and springs."""
        t, w = self.t, self.w
        m = np.where(t.free > 0, self.p.mass, 0.0).sum()
        reach = float(np.abs([self.low, self.high]).max())
        digit = 64 * t.eps * reach
        high = digit * fall / max(float((self.high - self.low).max()), 1e-300)
        alphas = [f.compliance[f.compliance > 0] for f in t.features if hasattr(f, "compliance")]
        stiff = sum(float((1 / a).sum()) for a in alphas)
        h = w._clock.h or 1.0
        return high + m * (digit / h) ** 2 + digit**2 * stiff

    def figures(self, report: tv.StepReport, x: np.ndarray) -> None:
        """Compare residual and overlap with brute force."""
        t, p = self.t, self.p
        reach = float(np.abs(x).max(initial=0.0))
        least = min(p.size, *(v for f in t.features if getattr(f, "joins", False) for v in np.abs(f.goal) if v > 0), 1e300)
        blur = 64 * t.eps * reach / least
        if blur < 1e-2:
            worst, whole, steep = oracles.rigid(t.features, t.free, x)
            near = max(1e-3 * worst, 1e-6 if t.eps < 1e-10 else 2e-3 if not whole else 1e-4, blur, 4 * t.eps * steep)
            if whole and abs(report.residual - worst) > near:
                self.find("residual", f"reported {report.residual:.6g}, by brute force {worst:.6g}, {report}")
            if report.residual < worst - near:
                self.find("residual", f"reported {report.residual:.6g}, rigid ones by brute force {worst:.6g}, {report}")
        for f in t.features:
            if type(f).__name__ == "ShapeMatch" and f.acts and report.residual < 0.1 and blur < 1e-3:
                # The last pass turned the cluster before others moved its particles, by no more than the residual they left.
                worst = oracles.unfit(f, t.free, x)
                if worst > 2 * report.residual + 1e-3 + blur:
                    self.find("residual", f"reported {report.residual:.6g}, cluster by brute force {worst:.6g}, {report}")
            if type(f).__name__ == "Contact" and p.radius.any():
                count, worst = oracles.overlap(f, t.features, p, t.free, x)
                worst = max(worst, oracles.in_walls(t.features, p, t.free, x) if not t.structure.periodic else report.overlap)
                some = p.radius[p.radius > 0].min()
                blur = 64 * t.eps * reach / some
                # What lies in a wall by less than twice the slop presses with no row, and is not told. What rests on a one-way
                # wall is told, as deep as places leave it, and is not found by brute force.
                walls = [f for f in t.features if type(f).__name__ in oracles.WALLS]
                slack = 0.0 if not walls else 2 * SLOP if all(f.one_way is None for f in walls) else BEYOND * SLOP
                if blur < 1e-2 and abs(report.overlap - worst) > max(1e-4 * worst, 1e-4 + blur, slack):
                    self.find(
                        "overlap",
                        f"reported {report.overlap:.6g} ({report.contacts}), by brute force {worst:.6g} ({count}), {report}",
                    )

    def walls(self, x: np.ndarray) -> None:
        """Check that particles outside of a wall stay outside."""
        holds = len(self.safe) == 1
        for k, some in self.safe.items() if self.watched else ():
            f = self.t.features[k]
            left = -oracles.gap(f, x, self.p.radius)[some]
            reach = float(np.abs(x).max()) + float(np.abs(getattr(f, "radius", 0.0)))
            # Beside contacts walls are rows, which may overlap by as much as is not flagged.
            left = left - (self.p.radius[some] * (1.0 if self.flags & RISKS else 0.05) if self.rows else 0)
            if len(left) and left.max() > 64 * self.t.eps * reach + 4e-6 * self.p.size * (self.t.eps > 1e-10):
                i = int(np.flatnonzero(some)[np.argmax(left)])
                kind = "wall" if holds else "wall, several"
                self.find(kind, f"{f!r} lets particle {i} in by {left.max():.3g} m, at {x[i]}, {set(self.flags)}")

    def momentum(self, event: Step, x: np.ndarray) -> None:
        """Check the momentum of scenes on which nothing acts."""
        if not self.closed:
            return
        m, v = self.p.mass, self.w.velocity
        if not np.isfinite(v).all():
            self.find("nan", f"velocity {v}, flags {set(self.flags)}")
        way = (x - self.x) / event.dt
        speed = max(np.abs(v).max(), np.abs(self.v).max(), np.abs(way).max())
        size = m.sum() * speed
        reach = np.abs(x).max() + np.abs(self.x).max()
        n = np.sqrt(self.w.last.substeps * self.w.last.iterations * self.steps * len(m))
        near = 64 * self.t.eps * n * size + 1e-300
        if np.abs(m @ v - m @ self.v).max() > near:
            self.find("momentum", f"of velocities {m @ self.v} -> {m @ v}, allowed {near:.3g}, {self.w.last}")
        blur = 64 * self.t.eps * n * m.sum() * reach / event.dt
        # Not checked if the host moved bodies, which it solves to 1e-9 of their size, or if particles sleep.
        moved = "moved" in self.w.last.flags or self.w.last.asleep
        if not moved and np.abs(m @ way - m @ self.v).max() > near + blur:
            self.find("momentum", f"of velocities {m @ self.v}, of positions {m @ way}, allowed {near + blur:.3g}, {self.w.last}")
        # Directions are those at the start, unless they are lost by a turn, a start off the constraints, or a collapse.
        sure = not self.flags & RISKS and oracles.central(self.t.structure) and self.w.last.turn < 41 and self.exact
        turned = np.abs(oracles.spin(m, x, v) - self.spin).max()
        if sure and turned > near * reach + 1e-9 * size * reach:
            self.find("spin", f"{self.spin} -> {oracles.spin(m, x, v)}, allowed {near * reach:.3g}, {self.w.last}")
