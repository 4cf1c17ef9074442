"""Copy the package without the files of features that a scene does not use, and without reports, recording and play."""

import ast
import os
import pathlib
import re
import shutil

PACKAGE = pathlib.Path(__file__).parents[2]
FOLDERS = ("colliders", "constraints", "contact", "forces")
HERE = ("child.py", "counting.py", "scenes.py")  # the files of this folder that the process of a scene runs
IGNORED = shutil.ignore_patterns("__pycache__", "recording", "live", "report", "commands")


def copy(folder: str, needs: frozenset[str]) -> str:
    """Make a copy in `folder`; return the path to import it from. needs: names of the feature files that stay."""
    bare = pathlib.Path(folder) / "tiverlet"
    shutil.copytree(PACKAGE, bare, ignore=IGNORED)
    kept = needed(bare, needs)
    names: dict[str, list[str]] = {}
    for part in FOLDERS:
        for file in (bare / part).glob("*.py"):
            if file.stem not in kept and file.stem != "__init__":
                file.unlink()
        init = bare / part / "__init__.py"
        lines = exports(init)
        names[part] = [name for module, name in lines if module in kept]
        init.write_text("".join(f"from .{module} import {name}\n" for module, name in lines if module in kept))
    imports = [f"from .{part} import {', '.join(some)}\n" for part, some in names.items() if some]
    imports += ["from .particles import Particles\n", "from .device.runtime import init\n", "from .world import World\n"]
    (bare / "__init__.py").write_text("from .device import runtime  # first\nfrom . import shapes\n" + "".join(imports))
    speed = bare / "report" / "speed"
    os.makedirs(speed)
    for init in (bare / "report" / "__init__.py", speed / "__init__.py"):
        init.write_text("")
    for name in HERE:
        shutil.copy(pathlib.Path(__file__).with_name(name), speed)
    return folder


def needed(bare: pathlib.Path, needs: frozenset[str]) -> set[str]:
    """Return `needs` and all files of the same folders that they and the rest of the package import."""
    kept, before = set(needs), set()
    inits = [bare / folder / "__init__.py" for folder in ("", *FOLDERS)]
    rest = [file for file in bare.rglob("*.py") if file.parent.name not in FOLDERS and file not in inits]
    for file in rest:
        kept |= set(re.findall(rf"^from \.+(?:{'|'.join(FOLDERS)})\.(\w+) import", file.read_text(), re.M))
    while kept != before:
        before = set(kept)
        for part in FOLDERS:
            for name in before:
                if (file := bare / part / f"{name}.py").is_file():
                    kept |= set(re.findall(r"^from \.(\w+) import", file.read_text(), re.M))
    return kept


def exports(init: pathlib.Path) -> list[tuple[str, str]]:
    """Return module and name of everything that the __init__ of a folder imports from that folder."""
    nodes = [n for n in ast.parse(init.read_text()).body if isinstance(n, ast.ImportFrom) and n.level == 1 and n.module]
    return [(str(n.module), alias.name) for n in nodes for alias in n.names]
