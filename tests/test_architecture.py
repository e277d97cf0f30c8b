"""The house rules: which module may import which, what is public, and what help must not load."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchptz

ROOT = Path(torchptz.__file__).parent
CORE = (
    *("batch", "calibration", "compiled", "displacement", "estimation", "files", "geometry"),
    *("intrinsics", "kernels", "lens", "observations", "patterns", "radial", "rectification"),
    *("zoom_interpolation", "zoom_knot", "zoom_table", "zoom_table_file"),
)
EDGE = ("cameras", "cli", "export", "fleet", "report", "scanning", "simulation")
PUBLIC = (
    *("Calibration", "CalibratedLens", "LinePatterns", "Observations", "Priors", "RadialLens"),
    *("Status", "ZoomTable", "calibrate", "estimate", "rectify"),
)


def sources(part: str) -> list[Path]:
    """Files of a module or package of torchptz."""
    file, folder = ROOT / f"{part}.py", ROOT / part
    return [file] if file.exists() else sorted(folder.rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Absolute names of all that a file imports, at any depth."""
    return names(ast.parse(path.read_text(encoding="utf-8")), path.relative_to(ROOT.parent).parts)


def names(tree: ast.AST, parts: tuple[str, ...]) -> set[str]:
    """As `imported`, of a tree whose file is ``parts``."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = [*parts[: -node.level]] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from torchptz import fleet` imports torchptz.fleet.
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


def parts_of(modules: set[str]) -> set[str]:
    """What directly belongs to torchptz among them: torchptz.fleet.solve -> fleet."""
    return {name.split(".")[1] for name in modules if name.startswith("torchptz.")}


class TestImports:
    @pytest.mark.parametrize("part", CORE)
    def test_the_core_knows_nothing_of_the_edge(self, part):
        files = sources(part)
        assert files
        for path in files:
            assert not parts_of(imported(path)) & set(EDGE), path

    @pytest.mark.parametrize(
        ("part", "forbidden"),
        [
            ("simulation", {"cameras", "scanning", "fleet", "cli"}),
            ("cameras", {"simulation", "scanning", "fleet", "cli"}),
        ],
    )
    def test_cameras_and_simulation_meet_only_on_the_wire(self, part, forbidden):
        files = sources(part)
        assert files
        for path in files:
            assert not parts_of(imported(path)) & forbidden, path

    def test_every_module_is_on_one_of_the_floors(self):
        there = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or path.is_dir()}
        assert there - {"__init__", "__pycache__"} <= {*CORE, *EDGE}

    @pytest.mark.parametrize(
        "line",
        [
            "import torchptz.fleet.solve",
            "from torchptz import fleet",
            "from torchptz.fleet import solve",
            "from torchptz.fleet.solve import solve",
            "from .fleet import solve",
            "from . import fleet",
            "def f():\n    from torchptz.fleet import solve",
        ],
    )
    def test_all_ways_to_import_are_seen(self, line):
        assert "fleet" in parts_of(names(ast.parse(line), ("torchptz", "lens.py")))


class TestPublicNames:
    @pytest.mark.parametrize("name", PUBLIC)
    def test_can_be_imported(self, name):
        assert name in torchptz.__all__
        assert getattr(torchptz, name).__name__ == name

    def test_all_that_is_listed_is_there(self):
        assert all(hasattr(torchptz, name) for name in torchptz.__all__)
        assert dir(torchptz) == sorted(torchptz.__all__)


def test_help_waits_for_neither_torch_nor_kornia():
    code = "import sys, torchptz.cli; print({'torch', 'kornia', 'cv2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
