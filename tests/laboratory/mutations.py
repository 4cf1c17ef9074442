"""Faults that the engine once had, put back one at a time: which tests notice."""

import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from tiverlet.report.output import Table

ROOT = pathlib.Path(__file__).parents[2]
LIMIT = 900  # seconds, after which the tests of a fault end


@dataclass(frozen=True)
class Fault:
    """A fault, and the commit that mended it: `now` stands once in the file, and `then` stood there."""

    commit: str
    what: str
    file: str
    now: str
    then: str
    tests: str  # files of tests in which it should show


FAULTS = (
    Fault("0c60d46f", "near() and contacts read in the middle of a frame", "device/interrupts.py",
          "        _turns.acquire()", "        _turns.acquire() if get_ident() == self._main else None", "interrupts"),
    Fault("2e02d9a5", "steady changes of the substep settle nothing", "step/runner.py",
          "return adapts or (dt == clock.frame[1] and", "return adapts or (False and", "guard direct"),
    Fault("28b072a5", "what stays violated under auto is called good", "step/adaptive.py",
          'if tries.verdict == "good" and off > 1 else', 'if tries.verdict == "good" and off > 1e9 else',
          "softness"),
    Fault("c7777034", "bounces off the corners of level walls", "contact/rows.py",
          "                        self.bounce.field[row] = 0\n            self.gap",
          "                        pass\n            self.gap",
          "public_scenes walls"),
    Fault("f5e4e243", "catches at seams of level walls", "contact/rows.py",
          "                self.gap.field[row] += depth * ti.max(up.dot(n), 0)",
          "                self.gap.field[row] += 0 * depth",
          "public_scenes polygons"),
    Fault("07f6193e", "explain() of a soft Pin raises", "step/explain.py",
          "        if not f.breaks:\n            continue\n", "", "reported_loads pins docs"),
    Fault("47520826", "lists before the first frame find no walls", "colliders/wall_tree.py",
          "values=-everywhere)", "values=everywhere)", "walls rows"),
    Fault("59c4b64d", "limits of angles end at straight in 3D", "constraints/angle_limit.py",
          "self.start.dim == 3:", "self.start.dim == 4:", "shapes angles"),
    Fault("fd09a33f", "no wait after multipliers: bits differ on threads", "step/row_pass.py",
          "f.dev.end_answer(c, self.rows)\n            self.team.wait()\n", "f.dev.end_answer(c, self.rows)\n",
          "touching_scenes answers"),
    Fault("2a70a0e9", "residuals do not tell what contacts left", "constraints/core/equation.py",
          "violation += A * self.left[c]", "violation += 0 * self.left[c]", "touching_scenes answers links"),
    Fault("17a838d5", "curves lose digits away from the origin", "constraints/core/on_curve.py",
          "middle = ((curve.a.min(axis=0) + curve.a.max(axis=0)) / 2)", "middle = (0 * curve.a[0])", "paths"),
    Fault("22b8430b", "a load taken back divides 0 by 0", "features/material.py",
          "if size > ti.max(most, 0):", "if size > most:", "tools"),
    Fault("015148ea", "auto resolves springs that are far too fast", "step/adaptive.py",
          "follows = (substeps**2 * w <= FASTEST**2 * alpha) |", "follows = (alpha > 0) |", "guard"),
    Fault("65e7e08a", "turns of constraints leave the range of f32", "constraints/core/corner_passes.py",
          "ti.sqrt(here) * ti.sqrt(there))", "ti.sqrt(here * there))", "properties"),
    Fault("7200377f", "notes give the last figures, not the worst", "step/step_report.py",
          "sorted(first.notes + last.notes, key=_badness)", "first.notes + last.notes", "flags"),
    Fault("4f1285cb", "overlaps with walls are not told", "step/step_report.py",
          "COMPRESSED = 0.05", "COMPRESSED = 0.5", "flags contact"),
    Fault("732c5685", "a linkage is off by 9 % unflagged", "step/step_report.py",
          "UNCONVERGED = 0.05", "UNCONVERGED = 0.2", "flags"),
    Fault("7795bec6", "the first overloaded constraint breaks, not the most", "solvers/breaks.py",
          "if overload >= ti.static(1 - ALIKE) * self.largest[i]:", "if overload >= 0 * self.largest[i]:",
          "reported_loads"),
    Fault("34775e33", "friction does not act where discs land: heaps half as steep", "contact/impulses.py",
          "(normal + self.rows.hit(row))", "(normal / 2 + self.rows.hit(row))", "grains rows statics"),
    Fault("3a993469", "a pair that passes within a substep is no row", "contact/rows.py",
          "| passes | ahead", "| ahead", "contact"),
    Fault("786a5f7c", "what lies still under a blow is told to move", "contact/impulses.py",
          "- self.excess(change - push + kick, change + kick)", "", "velocity rows"),
    Fault("02d0371e", "old overlap is a reason for an impulse", "contact/rows.py",
          "bend, gap = 1 / length, ti.max(length - distance, 0)", "bend, gap = 1 / length, length - distance",
          "contact rows placing"),
    Fault("ae0639b3", "what rests moves by rounding: x is summed in parts", "particles/state.py",
          "        self.x[i] = self.x0[i]\n        if ti.static(self.sums):",
          "        self.x[i] = self.x[i] + 0 * self.x0[i]\n        if ti.static(self.sums):",
          "statics rows determinism"),
    Fault("02d0371e", "passes never restart where they go uphill", "contact/impulses.py",
          "        if uphill > 0:\n            beta", "        if uphill > 1e30:\n            beta", "rows statics"),
    Fault("02d0371e", "impulses may give energy", "contact/impulses.py",
          "ti.cast(self.total(WORK) > allowed * self.total(LOAD), ti.i32)", "0", "rows links answers statics"),
    Fault("02d0371e", "what comes back within the substep bounces", "contact/rows.py",
          " and met > least and not rests", " and met > 0", "rows body_impacts statics"),
    Fault("02d0371e", "the eigenvalue of rows is too small: passes diverge", "contact/rows.py",
          "self.eigenvalue[i] = (s[0] + s[1]) / 2 + ti.sqrt(half * half + s[2] * s[2])", "self.eigenvalue[i] = (s[0] + s[1]) / 2",
          "rows contact pairs"),
    Fault("9d0a83a0", "systems answer places anew: a rod is thrown out", "contact/places.py",
          "            self.bodies.answers.begin_particle(i)\n\n    @ti.func\n    def relax",
          "            pass\n\n    @ti.func\n    def relax",
          "answers placing contact"),
    Fault("f0f2e897", "a start lacks no half kick", "step/integrator.py",
          "h2_effective = ti.select(fresh != 0, h2_effective / 2, h2_effective)",
          "h2_effective = ti.select(fresh != 0, h2_effective, h2_effective)", "free_motion order"),
    Fault("d8a476dd", "rigid links do not supply the kick that velocities lack", "step/integrator.py",
          "late = h * owed\n", "late = 0 * h * owed\n", "velocity softness order"),
    Fault("779c87a9", "drag is Euler's", "step/integrator.py",
          "    z = rate * h\n    if z < 1e-3:", "    z = rate * h\n    if z < 1e3:", "free_motion"),
    Fault("bdd20b14", "the pull of springs in velocities is one substep old", "constraints/core/spring.py",
          "return -(1 - self.stiff(c, h, w)) * grown / (alpha / (h * h) + W / 4)", "return 0 * grown * W",
          "properties velocity order conservation"),
    Fault("d3c0fae7", "a spring that turns stores energy that is not there", "constraints/core/spring.py",
          "return stored + theta * (borne - stored)", "return stored", "conservation energy_bound guard"),
    Fault("db7e397a", "velocity forces take no reaction along", "step/integrator.py",
          "reaction = d - self.free[i]\n", "reaction = 0 * (d - self.free[i])\n", "velocity_forces"),
    Fault("aaab462c", "sleepers are not woken by what touches them", "step/step.py",
          "self.sleep.call_touched(i, self.halves - 1 - now.half % self.halves)", "pass", "sleep"),
    Fault("c045ed68", "a turned disc keeps half of its spin in 3D", "particles/spin.py",
          "v0 * q[3] - v.dot(q0)", "v0 * q[3] + v.dot(q0)", "spin"),
    Fault("675ba779", "links that others imply are eliminated, too", "solvers/redundancy.py",
          "return is_rigid & ~chosen", "return is_rigid & ~chosen & False", "structures direct"),
    Fault("675ba779", "a body implies the wrong number of links", "solvers/redundancy.py",
          "return dim * int(movable.sum()) - motions[min(fixed, len(motions) - 1)]",
          "return dim * int(movable.sum()) - motions[min(fixed, len(motions) - 1)] - 1", "structures"),
    Fault("90f9d8ee", "what violations store is counted half", "step/softness.py",
          "(~b.broken & (sag > 0)), S)", "(~b.broken & (sag > 0)), S) / 4", "guard"),
    Fault("b3affc6c", "what stays stored is no part of what settling may cost", "step/settling.py",
          "bodies.energy(new, h) + kept - supply", "bodies.energy(new, h) - supply", "softness"),
    Fault("614ec68b", "faces are not renumbered where walls go", "step/build_again.py",
          "face[kept] = WALL + now[wall][: len(kept)]", "face[kept] = WALL + kept", "edits"),
    Fault("7ee942f9", "World.shift glides", "step/placing.py",
          "    _take(world, values, by)\n", "    _take(world, values)\n    world.position = world.position + by\n", "placing"),
    Fault("157ff264", "a late frame has substeps that are as much longer: ropes with heavy ends explode", "step/clock.py",
          "return max(1, min(round(substeps * dt / self.dt), LATE * substeps))", "return substeps + 0 * LATE", "ledger matrix"),
    Fault("90f9d8ee", "floors of conjugate gradients grow though steps converge: soft nets lose digits", "solvers/conjugate.py",
          "share = CONVERGED * self.sums[None][RZ_START]", "share = 0 * CONVERGED * self.sums[None][RZ_START]", "ledger matrix"),
    Fault("92ab3220", "motors have no bounds beside a contact", "contact/links.py",
          "        low, high = batch.dev.equation.bounds(c)\n        if ti.static(batch.arity > 0):",
          "        low, high = -ti.math.inf, ti.math.inf\n        if ti.static(batch.arity > 0):", "ledger matrix"),
)  # fmt: skip


def main(args) -> Iterator[Table]:
    """Yield a table of the faults (parts: beginnings of commits), and of the tests that notice each."""
    some = [f for f in FAULTS if not args.parts or any(f.commit.startswith(p) or p in f.what for p in args.parts)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        rows = list(pool.map(_row, some))
    caught = sum(row[3] != "no test" for row in rows)
    heads = ("mended in", "fault", "files of tests", "noticed by", "s")
    yield Table("Faults put back", heads, rows, [f"{caught} of {len(rows)} are noticed."])


def _row(fault: Fault) -> tuple[str, ...]:
    """Return the row of a fault: it is put into a copy of the package, and its tests run until one fails."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for part in ("tiverlet", "tests", "demos"):
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        path = folder / "tiverlet" / fault.file
        text = path.read_text()
        if text.count(fault.now) != 1:
            raise ValueError(
                f"mutations: {fault.file} has {text.count(fault.now)} times what {fault.commit} mended: {fault.now!r}"
            )
        path.write_text(text.replace(fault.now, fault.then))
        found = next(filter(None, (_failing(folder, file_of(test)) for test in fault.tests.split())), "no test")
    print(f"{fault.commit} {fault.what}: {found}", file=sys.stderr, flush=True)
    return fault.commit, fault.what, fault.tests, found, f"{time.perf_counter() - begin:.0f}"


def file_of(test: str) -> str:
    """Return the path of a file of tests, from the project's root; empty if there is none."""
    return next((str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob(f"test_{test}.py")), "")


def _failing(folder: pathlib.Path, file: str) -> str:
    """Return the first test of a file that fails; an empty string where all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "", "-n", "0", "-p", "no:cacheprovider", file]
    given = os.environ | {"PYTHONPATH": str(folder)}
    try:
        done = subprocess.run(command, cwd=folder, env=given, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return f"{file}, which does not end"
    found = re.search(r"^(?:FAILED|ERROR) (?:tests/)?(\S+)", done.stdout, re.MULTILINE)
    return found.group(1) if found else ""
