"""What is kept of compiled kernels, until a source changes; and who waits for numba."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torchptz.kernels import decorators

PACKAGE = Path(decorators.__file__).parent
ROOT = PACKAGE.parent

ENTRY = """
from tiny.compiled import SHIFT
from tiny.kernels.decorators import exact_kernel, kernel
from tiny.kernels.helper import moved


@kernel
def fast(x):
    return moved(x) + SHIFT


@exact_kernel
def exact(x):
    return moved(x) - SHIFT
"""
HELPER = """
from tiny.kernels.decorators import inlined


@inlined
def moved(x):
    return FACTOR * x
"""
CALL = """
from tiny.kernels import entry
for one in (entry.fast, entry.exact):
    print(one(3.0), len(one.stats.cache_hits), len(one.stats.cache_misses))
"""


@pytest.fixture
def package(tmp_path):
    """A package with a helper, two entry points and a constant from outside the kernels."""
    folder = tmp_path / "tiny"
    (folder / "kernels").mkdir(parents=True)
    for name in ("__init__.py", "kernels/__init__.py"):
        (folder / name).touch()
    for name in decorators.SOURCES:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    shutil.copy(decorators.__file__, folder / "kernels")
    (folder / "kernels" / "entry.py").write_text(ENTRY)
    (folder / "kernels" / "helper.py").write_text(HELPER.replace("FACTOR", "10.0"))
    (folder / "compiled.py").write_text("SHIFT = 1.0\n")
    return folder


def called(package: Path, kept: Path | str) -> list[list[float]]:
    """Of both kernels in a process of its own: the result, and how often one was found or not."""
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=True,
        env={"HOME": str(kept), "XDG_CACHE_HOME": str(kept), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    return [[float(word) for word in line.split()] for line in done.stdout.splitlines()]


class TestKept:
    def test_until_a_source_changes(self, package, tmp_path):
        assert called(package, tmp_path) == [[31, 0, 1], [29, 0, 1]]
        assert called(package, tmp_path) == [[31, 1, 0], [29, 1, 0]]
        # The entry point's own file stays as it is: numba by itself would not see these.
        (package / "kernels" / "helper.py").write_text(HELPER.replace("FACTOR", "20.0"))
        assert called(package, tmp_path) == [[61, 0, 1], [59, 0, 1]]
        (package / "compiled.py").write_text("SHIFT = 2.0\n")
        assert called(package, tmp_path) == [[62, 0, 1], [58, 0, 1]]
        (package / "elsewhere.py").write_text("OTHER = 1\n")
        assert called(package, tmp_path) == [[62, 1, 0], [58, 1, 0]]

    def test_not_where_nothing_can_be_written(self, package):
        # A file in place of the folder: whoever runs this might write to a folder that forbids it.
        (package / "kernels" / "__pycache__").touch()
        for _ in range(2):
            assert called(package, "/dev/null") == [[31, 0, 1], [29, 0, 1]]


def file_of(module: str) -> Path | None:
    """Of a module of the project, or of a package's own; None where there is no such module."""
    path = ROOT.parent.joinpath(*module.split("."))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((one for one in candidates if one.exists()), None)


def sources_of(path: Path) -> dict[Path, set[str]]:
    """Files of the project that a file imports from, and which of their names."""
    found: dict[Path, set[str]] = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            mine = [alias.name for alias in node.names if alias.name.startswith("torchptz")]
            found |= {file_of(name): set() for name in mine}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, path
            if (node.module or "").split(".")[0] != "torchptz":
                continue
            for alias in node.names:
                module = file_of(f"{node.module}.{alias.name}")
                if module is None:
                    found.setdefault(file_of(node.module), set()).add(alias.name)
                else:
                    found.setdefault(module, set())
    return found


class TestSources:
    def test_are_all_that_kernels_import_from(self):
        imported = {source for path in PACKAGE.glob("*.py") for source in sources_of(path)}
        outside = {one for one in imported if one.parent != PACKAGE}
        assert {one.relative_to(ROOT).as_posix() for one in outside} == set(decorators.SOURCES)

    def test_say_themselves_what_kernels_take_from_them(self):
        # What they had from elsewhere could change without them.
        for path in PACKAGE.glob("*.py"):
            for source, names in sources_of(path).items():
                tree = ast.parse(source.read_text(encoding="utf-8"))
                said = {
                    leaf.id
                    for node in tree.body
                    if isinstance(node, ast.Assign | ast.AnnAssign)
                    for leaf in ast.walk(node)
                    if isinstance(leaf, ast.Name) and isinstance(leaf.ctx, ast.Store)
                }
                said |= {
                    node.name
                    for node in tree.body
                    if isinstance(node, ast.FunctionDef | ast.ClassDef)
                }
                assert names <= said, f"{path.name} from {source.name}"

    def test_kernels_are_in_one_folder(self):
        # The package's sources are those of its folder, not of folders in it.
        assert {path.parent for path in PACKAGE.rglob("*.py")} == {PACKAGE}


class TestWaitingForNumba:
    @pytest.mark.parametrize(
        "code",
        [
            "import torchptz",
            "import torchptz.cli",
            "import torchptz; torchptz.estimate, torchptz.calibrate, torchptz.rectify",
        ],
    )
    def test_importing_does_not(self, code):
        assert "numba" not in self.modules(code)

    def test_help_does_not(self):
        code = "from torchptz.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass"
        modules = self.modules(code)
        assert "torchptz.cli" in modules or "torchptz.cli.main" in modules
        assert not {"numba", "torch"} & modules

    def test_estimating_does(self):
        code = (
            "import torch; from torchptz.estimation import estimate\n"
            "from torchptz.patterns import LinePatterns\n"
            "estimate(LinePatterns(torch.rand(1, 3, 4, 2) * 99, torch.ones(1, 3, 4).bool(), "
            "torch.full((1, 2), 100.0)))"
        )
        assert "numba" in self.modules(code)

    @staticmethod
    def modules(code: str) -> set[str]:
        """All that is loaded after some code in a process of its own."""
        code = f"import sys\n{code}\nprint('loaded', *sys.modules)"
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT.parent,
            capture_output=True,
            text=True,
            check=True,
        )
        return set(done.stdout.splitlines()[-1].split()[1:])
