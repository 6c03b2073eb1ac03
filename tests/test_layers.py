"""Imports go one way. The table below is the architecture; a new module of tbmfg takes its place in it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Each module or package sees those of the lines above, never one of its own line.
LEVELS = (
    ("errors",),
    ("registry",),
    ("timeseries", "yamltext", "storage", "workers"),
    ("geometry", "earth", "fields", "chance"),
    ("state", "rig"),
    ("sensors", "mcap", "inertial", "lidar", "evaluation"),
    ("measure", "gnss", "results", "comparison"),
    ("problem", "inference", "dual"),
    ("filters", "smoother", "diagnosis", "residuals", "given"),
    ("outcome",),
    ("prepare",),
    ("estimators", "bounds", "report", "mapping"),
    ("pipeline",),
    ("batch", "api"),
    ("doctor",),
    ("cli",),
    ("__main__",),
)
LEVEL_OF = {name: level for level, names in enumerate(LEVELS) for name in names}

# Narrower than the levels allow: what is measured with, and what is measured, stay apart.
ONLY = {"evaluation": {"errors", "timeseries", "geometry", "chance", "state"}}

# The simulators share the vocabulary of tbmfg and none of the equations that they put to the test.
DATASETS_SEE = {"errors", "timeseries", "yamltext", "geometry", "earth", "state", "rig", "mcap"}

HEAVY = {"gtsam", "numba", "scipy", "open3d", "plotly", "dask", "distributed", "kiss_icp", "small_gicp", "PyEMD"}


def imported(source: str) -> set[str]:
    """Every dotted name that ``source`` imports, inside functions as well; ``from a import b`` is a.b."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute, so that they can be read without their place"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def eager(source: str) -> set[str]:
    """What ``source`` imports as soon as it is imported itself."""
    tops = [node for node in ast.parse(source).body if isinstance(node, ast.Import | ast.ImportFrom)]
    return imported("\n".join(map(ast.unparse, tops)))


def units(names: set[str]) -> set[str]:
    """The modules and packages directly below tbmfg among ``names``; ``tbmfg.__version__`` is none."""
    parts = [name.split(".") for name in names]
    return {p[1] for p in parts if p[0] == "tbmfg" and len(p) > 1 and p[1] != "__version__"}


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def unit_of(path: Path) -> str:
    return path.relative_to(ROOT / "tbmfg").parts[0].removesuffix(".py")


def test_the_reading_of_imports():
    source = "import tbmfg.sensors as s\nfrom tbmfg import rig, __version__\ndef f():\n    from tbmfg.mcap.cdr import X"
    assert units(imported(source)) == {"sensors", "rig", "mcap"}


@pytest.mark.parametrize("path", sources("tbmfg"), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_module_sees_only_what_lies_below_it(path):
    names = imported(path.read_text("utf-8"))
    assert not {name for name in names if name.split(".")[0] in ("datasets", "benchmarks", "tests")}
    unit = unit_of(path)
    if unit == "__init__":
        assert eager(path.read_text("utf-8")) == {"typing.TYPE_CHECKING", "typing.Any"}, "the library loads when used"
        return
    assert unit in LEVEL_OF, f"{unit} has no place in LEVELS"
    seen = units(names) - {unit}
    below = {name for name, level in LEVEL_OF.items() if level < LEVEL_OF[unit]}
    assert seen <= ONLY.get(unit, below)


@pytest.mark.parametrize("path", sources("datasets"), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_simulators_are_independent_of_what_they_test(path):
    names = imported(path.read_text("utf-8"))
    assert units(names) <= DATASETS_SEE
    assert "benchmarks" not in {name.split(".")[0] for name in names}


@pytest.mark.parametrize("module", ["tbmfg", "tbmfg.rig", "tbmfg.cli"])
def test_help_and_configuration_load_nothing_heavy(module):
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not HEAVY & set(loaded.split())
