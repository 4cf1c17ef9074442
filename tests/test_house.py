"""The layout of the package: entries at its root, inheritance, imports without circles and of small depth, files per frame."""

import ast
import functools
import inspect
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.constraints.core.corner_passes import CornerPasses
from tiverlet.features.feature import Batch
from tiverlet.neighbours.neighbour_list import NeighbourList

from .conftest import ARCH, PATCHED, parsed

ROOT = Path(__file__).parents[1] / "tiverlet"
DEPTH = 16  # modules in a chain of imports
# Contracts say what a step calls on each kind of object. Their methods do nothing, or what most kinds do.
CONTRACTS = (
    "Acceleration", "Batch", "Collider", "PairContact", "Passes", "Place", "Quantity", "SemiIteration", "Shape", "Solver",
    "System",
)  # fmt: skip
# Classes whose kernel functions are inherited. Elsewhere objects hold the object that has the functions.
SHARED = ("Baseline", "Moving", "PairContact", "System")
INHERITED = 210  # lines that a constraint like Rope inherits
CHAIN = 4  # classes in a chain: what acts on particles, on how many of them, of which kind, and the class itself


# Cached functions, since every worker imports this file and should read nothing then.
@functools.cache
def modules() -> dict[str, ast.Module]:
    """Return all modules of the package by name."""
    out = {}
    for path, tree in parsed().items():
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = tree
    return out


def imported(name: str) -> list[str]:
    """Return the modules of the package that a module imports when it is imported: not in functions or under TYPE_CHECKING."""
    package = name if (ROOT.parent / name.replace(".", "/")).is_dir() else name.rpartition(".")[0]
    out: list[str] = []

    def look(body: list[ast.stmt]) -> None:
        """Collect the imports of statements."""
        for node in body:
            if isinstance(node, ast.ImportFrom) and node.level:
                parts = package.split(".")
                base = ".".join([*parts[: len(parts) + 1 - node.level], *filter(None, [node.module])])
                out.extend(m if (m := f"{base}.{a.name}") in modules() else base for a in node.names)
            if isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
                look(node.body + node.orelse)

    look(modules()[name].body)
    return [m for m in dict.fromkeys(out) if m != name]


def test_imports_are_shallow_and_go_in_no_circle():
    # The longest chain of imports is bounded, so that few modules must be read to understand one.
    chains: dict[str, tuple[str, ...]] = {}

    def chain(name: str, path: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Return the longest chain that begins at a module, to which `path` leads."""
        assert name not in path, " -> ".join((*path, name))
        if name not in chains:
            chains[name] = (name, *max((chain(below, (*path, name)) for below in imported(name)), key=len, default=()))
        return chains[name]

    longest = max(map(chain, modules()), key=len)
    assert len(longest) <= DEPTH, " -> ".join(longest)
    assert len(longest) > 10 and "tiverlet.step.build" in imported("tiverlet.world")  # shows that imports are found


@functools.cache
def kinds() -> set[type]:
    """Return all classes of the package."""
    every = (kind for name in modules() for kind in vars(import_module(name)).values())
    return {kind for kind in every if inspect.isclass(kind) and kind.__module__ in modules()}


def bases(kind: type) -> list[type]:
    """Return the direct base classes of a class in the package."""
    return [b for b in kind.__bases__ if b in kinds()]


def depth(kind: type, ground: tuple[str, ...] = CONTRACTS) -> int:
    """Return how many base classes of the package are below a class, down to those of `ground`, which do not count."""
    return 0 if kind.__name__ in ground else max((1 + depth(b, ground) for b in bases(kind)), default=0)


def test_classes_are_at_most_two_below_a_contract():
    # No chain of classes is longer than CHAIN, contracts included.
    assert [kind for kind in kinds() if depth(kind) > 2 or depth(kind, ()) >= CHAIN] == []
    assert depth(tv.Distance) == depth(tv.Mesh) == 2 and depth(tv.Gravity) == depth(tv.Direct) == 1
    assert depth(tv.Distance, ()) + 1 == CHAIN and depth(tv.Direct, ()) + 1 == 2


def test_classes_are_abstract_or_final():
    # Base classes are never instantiated: code is shared by holding an object.
    abstract, made = {b for kind in kinds() for b in bases(kind)}, set()
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
                *owner, last = ast.unparse(node.func).rsplit(".", 1)
                given = vars(import_module(name))
                made.add(str(getattr(given.get(owner[0]), last, None) if owner else given.get(last)))
    assert {*map(str, abstract)} & made == set()
    assert Batch in abstract and str(NeighbourList) in made


def lines(function: ast.FunctionDef) -> int:
    """Return the lines of code of a function, without its docstring."""
    body = [node for node in function.body if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))]
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def functions(kind: type, in_kernels: bool = False) -> list[ast.FunctionDef]:
    """Return the functions of a class; or those for kernels alone."""
    (node,) = (n for n in ast.walk(modules()[kind.__module__]) if isinstance(n, ast.ClassDef) and n.name == kind.__name__)
    some = [f for f in node.body if isinstance(f, ast.FunctionDef)]
    marks = ({ast.unparse(d) for d in f.decorator_list} & {"ti.func", "ti.kernel", "inline"} for f in some)
    return [f for f, marked in zip(some, marks, strict=True) if marked or not in_kernels]


def test_kernels_inherit_nothing_that_does_something():
    # Kernel functions that contracts define have one line, the default. A constraint inherits few lines for the host.
    abstract = {b for kind in kinds() for b in bases(kind)}
    long = {kind.__name__ for kind in abstract if any(lines(f) > 1 for f in functions(kind, in_kernels=True))}
    assert long == set(SHARED)
    assert lines(functions(CornerPasses, in_kernels=True)[0]) > 10  # shows that functions are found
    inherited = sum(lines(f) for kind in tv.Rope.__mro__[1:] if kind in kinds() for f in functions(kind))
    assert 100 < inherited <= INHERITED


def test_the_root_of_the_package_can_be_taken_in_at_a_glance():
    entries = [p.name for p in ROOT.iterdir() if p.name != "__pycache__"]
    assert len(entries) <= 25, sorted(entries)


@pytest.mark.slow
@pytest.mark.skipif(ARCH != "cpu" or not PATCHED, reason="launches go through other files there")
def test_a_frame_goes_through_few_files(world):
    # Host files only, with links and discs. These and the kernel's are the files to read for what a frame does.
    rope = tv.shapes.rope((0, 2), (1, 2), points=8)
    discs = np.stack([0.1 * np.arange(8), np.full(8, 0.05)], axis=1)
    w = world(
        tv.Particles(np.concatenate([rope.position, discs]), radius=0.05, pinned=[0]),
        [tv.Gravity(), tv.Distance(rope.links), tv.Contact(), tv.HalfSpace((0, 1), 0.0)], substeps=4,
    )  # fmt: skip
    w.run(0.1)
    files = set()
    sys.setprofile(lambda frame, event, _: files.add(frame.f_code.co_filename) if event == "call" else None)
    w.step(1 / 60)
    sys.setprofile(None)
    ours = sorted(str(path.relative_to(ROOT)) for path in map(Path, files) if path.is_relative_to(ROOT))
    assert "step/runner.py" in ours and len(ours) <= 15, ours
