"""Error against run time: sweep substeps, solvers and precisions of the cases, with the baselines on the same axes."""

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from typing import Any

from ..jobs import done, finishing
from ..output import machine
from .baselines import BASELINES
from .cases import CASES, LEFT_OUT, METHODS, Case, chosen
from .errors import ErrorReport, Missing, verdict
from .points import Task, curve

FARTHER = (4, 16)  # baselines also get these multiples of the most substeps, since theirs are cheaper
QUICK = 3  # efforts of a quick sweep


def plan(
    cases: Sequence[Case], methods: Iterable[str] | None, precisions: Sequence[str], efforts: Sequence[int] | None,
    baselines: bool, runs: int, quick: bool,
) -> tuple[list[Task], list[str]]:  # fmt: skip
    """Return the curves of a sweep, and those that it leaves out, with reasons.

    These are every method of a case in the first precision, its first method in the others, and the baselines.
    """
    tasks, refused = [], {}
    for case in cases:
        steps = tuple(efforts or case.efforts)
        steps = few(case, steps) if quick else steps
        for k, method in enumerate(methods or case.methods):
            for precision in precisions if k == 0 or methods else precisions[:1]:
                tasks.append(Task(case.name, method, precision, steps, runs))
        for name, kind in BASELINES.items() if baselines else ():
            if why := kind.refuses(case.build()[1]):
                refused.setdefault((name, why), []).append(case.name)
            else:
                tasks.append(Task(case.name, name, "f64", (*steps, *(steps[-1] * k for k in FARTHER)), runs))
    omissions = [f"{name} on {', '.join(names)}: {why}" for (name, why), names in refused.items()]
    if not baselines:
        omissions.append("the baselines: not asked for")
    return tasks, omissions


def few(case: Case, steps: tuple[int, ...]) -> tuple[int, ...]:
    """Return the substeps of a quick sweep: those that show the order, and that at which the limit is checked."""
    fit = [s for s in case.fit or steps if s in steps]
    middle = fit if case.fit else [s for s in fit if s >= case.at] or fit
    return tuple(sorted({*middle[:QUICK], *(s for s in steps if s == case.at)}))


def error_vs_time(
    cases: Sequence[str] | str | None = None, *, methods: Sequence[str] | None = None,
    precisions: Sequence[str] = ("f64", "f32"), efforts: Sequence[int] | None = None, baselines: bool = True, runs: int = 5,
    executor: Executor | Any = None, progress: bool = False, quick: bool = False,
) -> ErrorReport:  # fmt: skip
    """Measure error against run time on scenes with known answers.

    cases: names or beginnings of names in tv.report.CASES ("D01", "S"); None for all. methods: names in tv.report.METHODS for
    every case; None for those that each case names. precisions: the first for every method, the others for the first method.
    efforts: substeps of a frame; None for those of each case. baselines: also measure the article's scheme and textbook XPBD.
    runs: timed runs of a point, after the run whose error is measured; the median counts (fewer runs if one takes long).
    executor: an object with submit(), as in concurrent.futures. Its workers measure the curves; they must not be forked from a
    process that has started Taichi (use the start method "spawn"). Curves of a worker that dies are named in .missing.
    quick: fewer substeps and one timed run. progress: print the verdict on each case as it finishes, in a terminal with a bar.

    Protocol: Rackauckas and Nie, SciMLBenchmarks (work-precision diagrams with omissions).
    """
    for name in methods or ():
        if name not in METHODS:
            raise ValueError(f"error_vs_time: methods has {name!r}, but there are {', '.join(METHODS)}.")
    some = chosen(cases)
    tasks, omissions = plan(some, methods, precisions, efforts, baselines, 1 if quick else runs, quick)
    points, missing, curves = [], [], Counter(task.case for task in tasks)
    with finishing("error against run time", len(tasks), progress) as say:
        for task, made, why in done(curve, tasks, executor):
            points += made or []
            missing += [Missing(task.case, str(task), why)] if why else []
            curves[task.case] -= 1
            say("" if curves[task.case] else verdict(task.case, points, [m for m in missing if m.case == task.case]))
    order = {name: k for k, name in enumerate(CASES)}
    points.sort(key=lambda p: (order[p.case], p.method in BASELINES))
    left = [f"{name}: {why}" for name, why in LEFT_OUT.items()] if cases is None else []
    return ErrorReport([c.name for c in some], points, missing, omissions + left, machine())
