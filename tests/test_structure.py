"""The house: who may import whom, the links under one import name, and what the wheel holds."""

from __future__ import annotations

import ast
import graphlib
import importlib.util
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("core", "adapters", "configs", "flows")
#: What a part may import of modetune.
MAY_IMPORT = {
    "core": {"core"},
    "adapters": {"adapters", "core"},
    "configs": {"configs", "adapters", "core"},
    "flows": {"flows", "configs", "adapters", "core"},
}
#: What core may import besides the standard library.
CORE_LIBRARIES = {"modetune", "numpy", "scipy", "h5py", "pypardiso"}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("modetune", *(parts[:-1] if parts[-1] == "__init__" else parts)))


MODULES = {
    module_name(path): path for part in PARTS for path in sorted((ROOT / part).rglob("*.py"))
}


def imports(path: Path) -> set[str]:
    """Full names of everything a file imports, wherever in it; relative ones resolved."""
    found: set[str] = set()
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, node.module] if node.module else above)
            found.update(f"{base}.{alias.name}" for alias in node.names)
    return found


def module_of(name: str) -> str | None:
    """The module of ours that an imported name is, or stands in."""
    while name:
        if name in MODULES:
            return name
        name = name.rpartition(".")[0]
    return None


def test_there_are_modules_in_every_part() -> None:
    assert {name.split(".")[1] for name in MODULES} == set(PARTS)


@pytest.mark.parametrize("part", PARTS)
def test_imports_go_one_way(part: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for module, path in MODULES.items()
        if module.split(".")[1] == part
        for name in sorted(imports(path))
        if name.startswith("modetune.") and name.split(".")[1] in PARTS
        if name.split(".")[1] not in MAY_IMPORT[part]
    ]
    assert wrong == []


@pytest.mark.parametrize("part", PARTS)
def test_nothing_is_imported_by_its_bare_folder_name(part: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in MODULES.values()
        for name in sorted(imports(path))
        if name.split(".")[0] == part
    ]
    assert wrong == []  # it would give a second copy of every class


def test_core_stands_on_numbers_and_hdf5_only() -> None:
    allowed = CORE_LIBRARIES | set(sys.stdlib_module_names)
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for module, path in MODULES.items()
        if module.startswith("modetune.core")
        for name in sorted(imports(path))
        if name.split(".")[0] not in allowed
    ]
    assert wrong == []


def test_modules_do_not_import_each_other_in_a_ring() -> None:
    graph = {
        module: {found for name in imports(path) if (found := module_of(name))} - {module}
        for module, path in MODULES.items()
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the ring


def test_every_module_that_is_imported_exists() -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in MODULES.values()
        for name in sorted(imports(path))
        if name.startswith("modetune.") and name.split(".")[1] in PARTS
        if module_of(name) is None
    ]
    assert wrong == []


@pytest.mark.parametrize("part", PARTS)
def test_links_under_the_import_name_are_relative_and_lead_to_the_root(part: str) -> None:
    link = ROOT / "src" / "modetune" / part
    assert link.is_symlink()
    assert not link.readlink().is_absolute()
    assert link.resolve() == ROOT / part
    spec = importlib.util.find_spec(f"modetune.{part}")
    assert spec is not None
    assert spec.origin is not None
    assert Path(spec.origin).resolve() == ROOT / part / "__init__.py"


def copy_of_sources(folder: Path) -> None:
    """What a wheel is built from, links as links; what runs leave in the folders stays out."""
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    ignore = shutil.ignore_patterns("__pycache__", ".modetune", "runs", ".*")
    for name in ("src", *PARTS):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=ignore)


def test_the_wheel_holds_every_module(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="the build backend is not installed")
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    copy_of_sources(source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)]
    ended = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (wheel,) = out.glob("modetune-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    wanted = {f"modetune/{path.relative_to(ROOT).as_posix()}" for path in MODULES.values()}
    assert wanted - held == set()
    assert {"modetune/__init__.py", "modetune/py.typed"} <= held
