"""A catalogue of small scenes. test_scenes.py asserts of all of them what must hold in every scene."""

from importlib import import_module
from pathlib import Path

from .scene import ALL as SCENES

for path in sorted(Path(__file__).parent.glob("*.py")):
    if path.stem not in ("__init__", "scene"):
        import_module(f".{path.stem}", __name__)

__all__ = ["SCENES"]
