"""The layout: how much lies at the root of the package, how deep classes inherit, and that imports go one way, not deep."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1] / "tiverlet"
DEPTH = 16  # modules, one importing the next
CONTRACTS = ("Acceleration", "Batch", "Collider", "PairContact", "Solver")  # what a step asks of each kind of object


def modules() -> dict[str, ast.Module]:
    """All modules of the package by their names."""
    out = {}
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return out


MODULES = modules()


def imported(name: str) -> list[str]:
    """The modules of ours that a module imports when it is imported itself."""
    package = name if (ROOT.parent / name.replace(".", "/")).is_dir() else name.rpartition(".")[0]
    out: list[str] = []

    def look(body: list[ast.stmt]) -> None:
        """What statements import, those in functions and under TYPE_CHECKING left out."""
        for node in body:
            if isinstance(node, ast.ImportFrom) and node.level:
                base = ".".join(package.split(".")[: len(package.split(".")) + 1 - node.level] + (node.module or "").split("."))
                base = base.rstrip(".")
                out.extend(f"{base}.{a.name}" if f"{base}.{a.name}" in MODULES else base for a in node.names)
            elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
                look(node.body + node.orelse)

    look(MODULES[name].body)
    return [m for m in dict.fromkeys(out) if m != name]


def test_imports_go_in_no_circle():
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        """Look at what a module imports, and at what that imports."""
        assert name not in path, " -> ".join((*path[path.index(name) :], name))
        if name not in done:
            for below in imported(name):
                visit(below, (*path, name))
            done.add(name)

    for name in MODULES:
        visit(name, ())


def test_imports_are_shallow():
    # The longest chain of modules, each of which the one before imports, so that what is read to the ground stays little.
    chains: dict[str, tuple[str, ...]] = {}

    def chain(name: str) -> tuple[str, ...]:
        """The longest one that begins there."""
        if name not in chains:
            chains[name] = (name, *max(map(chain, imported(name)), key=len, default=()))
        return chains[name]

    longest = max(map(chain, MODULES), key=len)
    assert len(longest) <= DEPTH, " -> ".join(longest)
    assert chain("tiverlet.world")[-1] == "tiverlet.device.language"  # and imports are seen


def test_classes_are_at_most_two_below_a_contract():
    # A contract of CONTRACTS counts as the ground, as does what is no class of ours.
    kinds: dict[str, list[ast.ClassDef]] = {}
    for tree in MODULES.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                kinds.setdefault(node.name, []).append(node)

    def depth(name: str) -> int:
        """Of the deepest class of that name."""
        bases = [ast.unparse(b).rpartition(".")[2] for kind in kinds.get(name, []) for b in kind.bases]
        return 0 if name in CONTRACTS or not bases else max(1 + depth(b) if b in kinds else 0 for b in bases if b != name)

    assert all(name in kinds for name in CONTRACTS)
    assert {name: d for name in kinds if (d := depth(name)) > 2} == {}
    assert depth("Distance") == depth("Mesh") == 2 and depth("Gravity") == depth("Direct") == 1


def test_the_root_of_the_package_can_be_taken_in_at_a_glance():
    entries = [p.name for p in ROOT.iterdir() if p.name != "__pycache__"]
    assert len(entries) <= 25, sorted(entries)
