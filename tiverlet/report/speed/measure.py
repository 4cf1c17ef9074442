"""Measure speed: choose sizes and threads, run the processes, and collect their figures."""

import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from rich.progress import Progress

from ... import checks
from ..output import error_line, machine
from . import c_baseline, processes, stripped
from . import peers as others
from . import waits as edits
from .result import Absent, Peer, Run, SpeedReport, Wait
from .scenes import SCENES

BLOCK = 1 << 28  # bytes of each array in the copy: many times the caches
FRAMES = (12, 60)  # least and largest number of timed frames in a round
WORK = 5e7  # particle-substeps of a round, within FRAMES
TURN = 1e6  # particle-substeps of a turn, which has at least 6 frames and at most a round
ROUNDS, SECONDS = 25, 2.0  # most rounds; seconds of tiverlet's own frames after which no round begins
QUICK = (3, 0.2)  # ROUNDS and SECONDS of a quick report
EDITED = 4000  # discs of the pile that is edited
PAIRS = 5  # of processes with and without the rest of the package: the placement of memory changes times by some percent


def speed(
    scenes: Sequence[str] | str | None = None, *, sizes: Iterable[int] | None = None, threads: Iterable[int] | None = None,
    arch: str = "cpu", quick: bool = False, yardstick: bool = True, peers: bool = True, absent: bool = True, waits: bool = True,
    progress: bool = False,
) -> SpeedReport:  # fmt: skip
    """Measure the speed of scenes, beside a pile written by hand in C and other engines, and the cost of first steps.

    scenes: names in SCENES; None for all. sizes: numbers of particles; None for those of each scene. threads: numbers of CPU
    threads; None for 1, 2, 4, ... up to all cores. arch: as in tv.init; on a GPU, pile.c runs on all cores. quick: two small
    sizes, and few rounds. yardstick: also run pile.c, if there is a C compiler. peers: also run pymunk and newton, if they are
    installed. absent: compare with a copy of the package without the files that the scene does not use. waits: time edits of a
    pile. progress: show a bar.

    A scene is run over its first frames repeatedly, alternating with pile.c. Medians and the ratio of medians are reported.
    Raises ValueError for unknown scenes and for invalid sizes or threads. Failures during the run are named in .notes.
    """
    names = chosen(scenes)
    number = os.cpu_count() or 1
    cores = numbers("threads", threads) or (powers(number) if arch == "cpu" else (number,))
    wanted = numbers("sizes", sizes)
    ladder = {name: wanted or (SCENES[name].quick if quick else SCENES[name].sizes) for name in names}
    session = Session(arch, cores, quick)
    with tempfile.TemporaryDirectory() as folder, Progress(disable=not progress) as bar:
        row = bar.add_task("speed", total=sum(map(len, ladder.values())))
        session.folder = folder
        if yardstick and any(SCENES[name].in_c for name in names):
            session.compile()
        for name, sizes_ in ladder.items():
            for n in sizes_:
                bar.update(row, description=f"{name}, {n}")
                with session.errors_as_notes(f"{name}, {n} particles"):
                    session.runs += session.point(name, n)
                bar.advance(row)
        for name in names if peers else ():
            session.beside(name, min(ladder[name], key=lambda n: abs(n - others.SIZES.get(name, n))))
        for name in names if absent else ():
            if SCENES[name].needs is not None:
                with session.errors_as_notes(f"{name} without the rest of the package"):
                    session.absent.append(session.without(name, min(ladder[name], key=lambda n: abs(n - 1000))))
        found = session.waits(peers) if waits and "pile" in names else []
        copy = {t: bandwidth(t) if arch == "cpu" else session.copy() for t in cores}
    s = session
    return SpeedReport(machine(), arch, copy, tuple(s.runs), tuple(s.peers), tuple(s.absent), tuple(found), tuple(s.notes))


class Session:
    """The measurements of one report, and their results so far."""

    def __init__(self, arch: str, cores: Sequence[int], quick: bool):
        self.arch, self.cores, self.folder = arch, cores, ""
        self.rounds, self.seconds = QUICK if quick else (ROUNDS, SECONDS)
        self.program: str | None = None
        self.runs: list[Run] = []
        self.peers: list[Peer] = []
        self.absent: list[Absent] = []
        self.notes: list[str] = []
        self._caches = 0

    def compile(self) -> None:
        """Compile pile.c, or add a note with the reason why it was not compiled."""
        self.program, how = c_baseline.build(self.folder)
        self.notes.append(f"pile.c: {how}." if self.program else f"Left out: the yardstick pile.c, since {how}.")

    @contextmanager
    def errors_as_notes(self, what: str) -> Iterator[None]:
        """Turn errors inside the context into notes."""
        try:
            yield
        except (RuntimeError, OSError) as error:
            self.notes.append(f"Missing: {what}: {error_line(error)}")

    def cache(self) -> str:
        """Return the path of a new, empty folder for compiled kernels."""
        self._caches += 1
        return os.path.join(self.folder, f"cache{self._caches}")

    def job(self, name: str, n: int, threads: int) -> dict[str, Any]:
        """Return the job for the process of a scene, see child.py."""
        return {"scene": name, "n": n, "threads": threads, "arch": self.arch}

    def copy(self) -> float:
        """Return the bandwidth of a copy on the device [bytes per second]."""
        with processes.world(self.job("rope", 2, 1), self.cache()) as one:
            one.ask()
            return one.ask("copy")

    def frames(self, n: int, substeps: int) -> int:
        """Return the number of frames of a round."""
        return int(np.clip(WORK // (n * substeps), *FRAMES))

    def turns(self, talkers: Sequence[processes.Talker], n: int, substeps: int, settles: int = 0) -> list[list[float]]:
        """Return the seconds per frame of each process in each round, see side_by_side()."""
        frames = self.frames(n, substeps)
        group = int(np.clip(TURN // (n * substeps), 6, frames))
        return processes.side_by_side(talkers, frames, group, self.rounds, self.seconds, settles)

    def point(self, name: str, n: int) -> list[Run]:
        """Measure a scene of one size on all numbers of threads.

        Bits, and so work and quality, do not depend on the number of threads; they are measured once.
        """
        out: list[Run] = []
        scene, same = SCENES[name], {}
        frames = self.frames(n, scene.substeps)
        for threads in sorted(self.cores, reverse=True):
            job, cache = self.job(name, n, threads), self.cache()
            with processes.world(job, cache) as once:
                cold = once.ask()
            with ExitStack() as stack:
                ours = stack.enter_context(processes.world(job, cache))
                warm = ours.ask()
                both = [ours]
                if self.program and scene.in_c:
                    both.append(stack.enter_context(c_baseline.started(self.program, n, scene.in_c, threads)))
                times = self.turns(both, n, scene.substeps, scene.settles)
                if not same:
                    qualities = [processes.quality(talker, frames, scene.settles) for talker in both]
                    work = warm["particles"] * scene.substeps
                    same = {**qualities[0], "traffic": {}, "times": {}}
                    for kernel, (moved, seconds) in ours.ask("traffic").items():
                        same["traffic"][kernel], same["times"][kernel] = moved / work, seconds / work
                    same["yardstick_overlap"] = qualities[1]["overlap"] if len(both) > 1 else None
                look = ours.ask("look")
            out.append(Run(
                name, warm["particles"], threads, look["path"], scene.substeps, median(times[0]), len(times[0]), look["launches"],
                memory=look["memory"] / warm["particles"], imported=median([cold["import"], warm["import"]]), cold=first(cold),
                warm=first(warm), flags=tuple(look["flags"]), yardstick=median(times[1]) if len(both) > 1 else None, **same,
            ))  # fmt: skip
        return out[::-1]

    def beside(self, name: str, n: int) -> None:
        """Measure all installed peers on a scene, each with all threads that it can use."""
        for peer in others.PEERS.values():
            if name in peer.scenes:
                if why := peer.missing():
                    self.notes.append(f"Left out: {peer.name} on {name}, since {why}.")
                    continue
                with self.errors_as_notes(f"{peer.name} on {name}, {n} particles"):
                    self.peers.append(self.compare(peer, name, n))

    def compare(self, peer: "others.Engine", name: str, n: int) -> Peer:
        """Find a peer's cheapest setting that is as good as tiverlet's, or its best; then time both in alternation."""
        scene, threads = SCENES[name], min(self.cores[-1], peer.threads)
        frames, measure = self.frames(n, scene.substeps), others.MEASURE[name]
        with processes.world(self.job(name, n, threads), self.cache()) as ours:
            ours.ask()
            target = processes.quality(ours, frames, scene.settles)[measure]
            tried: list[tuple[float, tuple[int, int]]] = []
            fast = ours.ask("run 12")
            for setting in peer.settings:
                with peer.process(name, n, threads, setting) as theirs:
                    theirs.ask()
                    tried.append((processes.quality(theirs, frames, scene.settles)[measure], setting))
                    slow = theirs.ask("run 12") > others.SLOWER * fast
                if slow or tried[-1][0] <= target:
                    break
            quality, setting = tried[-1] if tried[-1][0] <= target else min(tried)
            with peer.process(name, n, threads, setting) as theirs:
                count = theirs.ask()["particles"]
                times = self.turns([ours, theirs], n, scene.substeps, scene.settles)
        return Peer(
            f"{peer.name} {peer.version()}", name, count, threads, setting,
            median(times[1]), median(times[0]), others.WORDS[measure], quality, target, quality <= target,
        )  # fmt: skip

    def waits(self, peers: bool) -> list[Wait]:
        """Measure the time of edits of a pile, by tiverlet and by the installed peers."""
        names = [peer.name for peer in others.PEERS.values() if peers and not peer.missing()]
        with self.errors_as_notes("waits"):
            few = self.rounds != ROUNDS
            return edits.waits(EDITED // 10 if few else EDITED, edits.QUICK if few else edits.TIMES, self.cache(), names)
        return []

    def without(self, name: str, n: int) -> Absent:
        """Measure a scene by this package, and by a copy that has only the features of the scene."""
        scene = SCENES[name]
        assert scene.needs is not None
        bare = stripped.copy(os.path.join(self.folder, f"bare_{name}"), scene.needs)
        job, caches = self.job(name, n, 1), (self.cache(), self.cache())
        times: tuple[list[float], list[float]] = [], []
        for _ in range(1 if self.rounds == QUICK[0] else PAIRS):
            with processes.world(job, caches[0]) as whole, processes.world(job, caches[1], bare) as part:
                count = whole.ask()["particles"]
                if not (package := part.ask()["package"]).startswith(bare):
                    raise RuntimeError(f"{package} was imported instead of the copy")
                both = self.turns([whole, part], n, scene.substeps)
                a, b = whole.ask("look"), part.ask("look")
            for some, more in zip(times, both, strict=True):
                some += more
        return Absent(
            name, count, fields=(a["fields"], b["fields"]), bytes=(a["memory"], b["memory"]),
            launches=(a["launches"], b["launches"]), seconds=(median(times[0]), median(times[1])),
        )  # fmt: skip


def first(start: dict[str, float]) -> float:
    """Return the seconds from tv.init to the end of the first step, without building the arrays of the scene."""
    return start["start"] + start["first"]


def chosen(scenes: Sequence[str] | str | None) -> list[str]:
    """Return the names of scenes, each once. Raises ValueError for an unknown name."""
    names = list(SCENES) if scenes is None else [scenes] if isinstance(scenes, str) else list(scenes)
    for name in names:
        if name not in SCENES:
            raise ValueError(f"speed: there is no scene {name!r}, but {', '.join(SCENES)}.")
    return list(dict.fromkeys(names))


def numbers(what: str, given: Iterable[int] | None) -> tuple[int, ...]:
    """Return sizes or threads in ascending order, each once. Raises ValueError for invalid ones. what: "sizes" or "threads"."""
    return tuple(sorted({checks.integer("speed", what, n, least=2 if what == "sizes" else 1) for n in given or ()}))


def powers(cores: int) -> tuple[int, ...]:
    """Return the numbers of threads 1, 2, 4, ... and all cores."""
    return tuple(sorted({*(1 << k for k in range(cores.bit_length())), cores}))


def bandwidth(threads: int) -> float:
    """Return the bytes per second that are read and written in a copy of a large array, split among threads; the best of five."""
    source, target = np.ones(BLOCK // 8), np.zeros(BLOCK // 8)
    parts = list(zip(np.array_split(target, threads), np.array_split(source, threads), strict=True))
    best = np.inf
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(5):
            clock = perf_counter()
            list(pool.map(lambda pair: np.copyto(*pair), parts))
            best = min(best, perf_counter() - clock)
    return 2 * BLOCK / best
