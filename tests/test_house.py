"""The layout of the package: entries at its root, inheritance, imports without circles and of small depth, files per frame."""

import ast
import functools
import sys
from pathlib import Path

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device.patches import patched

from .conftest import ARCH, parsed

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


def named(module: str, node: ast.AST) -> dict[str, tuple[str, str]]:
    """Return what an import of the package defines in a module: name -> (module, name in it), where "" is the module itself."""
    if not isinstance(node, ast.ImportFrom) or not node.level:
        return {}
    package = module if (ROOT.parent / module.replace(".", "/")).is_dir() else module.rpartition(".")[0]
    base = ".".join([*package.split(".")[: len(package.split(".")) + 1 - node.level], *filter(None, [node.module])])
    return {a.asname or a.name: (m, "") if (m := f"{base}.{a.name}") in modules() else (base, a.name) for a in node.names}


def imported(name: str) -> list[str]:
    """Return the modules of the package that a module imports when it is imported."""
    out: list[str] = []

    def look(body: list[ast.stmt]) -> None:
        """Collect the imports of statements, except in functions and under TYPE_CHECKING."""
        for node in body:
            out.extend(module for module, _ in named(name, node).values())
            if isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
                look(node.body + node.orelse)

    look(modules()[name].body)
    return [m for m in dict.fromkeys(out) if m != name]


@pytest.mark.slow
def test_imports_go_in_no_circle():
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        """Check the imports of a module, and recursively theirs."""
        assert name not in path, " -> ".join((*path[path.index(name) :], name))
        if name not in done:
            for below in imported(name):
                visit(below, (*path, name))
            done.add(name)

    for name in modules():
        visit(name, ())


def test_imports_are_shallow():
    # The longest chain of imports is bounded, so that few modules must be read to understand one.
    chains: dict[str, tuple[str, ...]] = {}

    def chain(name: str) -> tuple[str, ...]:
        """Return the longest chain that begins at a module."""
        if name not in chains:
            chains[name] = (name, *max(map(chain, imported(name)), key=len, default=()))
        return chains[name]

    longest = max(map(chain, modules()), key=len)
    assert len(longest) <= DEPTH, " -> ".join(longest)
    assert len(longest) > 10 and "tiverlet.step.build" in imported("tiverlet.world")  # shows that imports are found


@functools.cache
def kinds() -> dict[tuple[str, str], ast.ClassDef]:
    """Return all classes of the package by module and name."""
    return {(m, node.name): node for m, tree in modules().items() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


@functools.cache
def origins() -> dict[str, dict[str, tuple[str, str]]]:
    """Return for each module the names that its imports define."""
    return {m: {k: v for node in ast.walk(tree) for k, v in named(m, node).items()} for m, tree in modules().items()}


def kind_of(module: str, said: ast.expr) -> tuple[str, str] | None:
    """Return the class of the package, by module and name, to which an expression refers in a module."""
    if isinstance(said, ast.Attribute) and isinstance(said.value, ast.Name):
        module, name = origins()[module].get(said.value.id, ("", ""))[0], said.attr
    else:
        name = said.id if isinstance(said, ast.Name) else ""
    while module and (module, name) not in kinds():
        module, name = origins()[module].get(name, ("", ""))
    return (module, name) if module else None


@functools.cache
def bases() -> dict[tuple[str, str], list[tuple[str, str]]]:
    """Return for each class its direct base classes in the package."""
    return {kind: [b for said in node.bases if (b := kind_of(kind[0], said))] for kind, node in kinds().items()}


def depth(kind: tuple[str, str], ground: tuple[str, ...] = CONTRACTS) -> int:
    """Return how many base classes of the package are below a class, down to those of `ground`, which do not count."""
    return 0 if kind[1] in ground else max((1 + depth(b, ground) for b in bases()[kind]), default=0)


@pytest.mark.slow
def test_classes_are_at_most_two_below_a_contract():
    # No chain of classes is longer than CHAIN, contracts included.
    by = {kind[1]: kind for kind in kinds()}
    assert {kind: d for kind in kinds() if (d := depth(kind)) > 2} == {}
    assert {kind: d for kind in kinds() if (d := depth(kind, ()) + 1) > CHAIN} == {}
    assert depth(by["Distance"]) == depth(by["Mesh"]) == 2 and depth(by["Gravity"]) == depth(by["Direct"]) == 1
    assert depth(by["Distance"], ()) + 1 == CHAIN and depth(by["Direct"], ()) + 1 == 2


def test_classes_are_abstract_or_final():
    # Base classes are never instantiated: code is shared by holding an object.
    abstract = {b for below in bases().values() for b in below}
    calls = {m: [node for node in ast.walk(tree) if isinstance(node, ast.Call)] for m, tree in modules().items()}
    made = {kind for m, some in calls.items() for node in some if (kind := kind_of(m, node.func))}
    assert abstract & made == set()
    assert ("tiverlet.features.feature", "Batch") in abstract and ("tiverlet.neighbours.neighbour_list", "NeighbourList") in made


def lines(function: ast.FunctionDef) -> int:
    """Return the lines of code of a function, without its docstring."""
    body = [node for node in function.body if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))]
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def functions(kind: tuple[str, str], in_kernels: bool | None = None) -> list[ast.FunctionDef]:
    """Return the functions of a class: all, those for kernels, or those for the host."""
    some = [node for node in kinds()[kind].body if isinstance(node, ast.FunctionDef)]
    marks = {id(f): bool({ast.unparse(d) for d in f.decorator_list} & {"ti.func", "ti.kernel", "inline"}) for f in some}
    return [f for f in some if in_kernels is None or marks[id(f)] == in_kernels]


def above(kind: tuple[str, str]) -> list[tuple[str, str]]:
    """Return all base classes of a class in the package."""
    return [a for b in bases()[kind] for a in (b, *above(b))]


def test_kernels_inherit_nothing_that_does_something():
    # Kernel functions that contracts define have one line, the default. A constraint inherits few lines for the host.
    by = {kind[1]: kind for kind in kinds()}
    abstract = {b for below in bases().values() for b in below}
    long = {kind[1] for kind in abstract if any(lines(f) > 1 for f in functions(kind, in_kernels=True))}
    assert long == set(SHARED)
    assert lines(functions(by["CornerPasses"], in_kernels=True)[0]) > 10  # shows that functions are found
    inherited = sum(lines(f) for kind in above(by["Rope"]) for f in functions(kind))
    assert 100 < inherited <= INHERITED


def test_the_root_of_the_package_can_be_taken_in_at_a_glance():
    entries = [p.name for p in ROOT.iterdir() if p.name != "__pycache__"]
    assert len(entries) <= 25, sorted(entries)


@pytest.mark.slow
@pytest.mark.skipif(ARCH != "cpu" or not patched, reason="launches go through other files there")
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
