"""The house: who may import whom, the links under one import name, and what the wheel holds."""

from __future__ import annotations

import ast
import graphlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer

from modetune.flows.campaign.schema import campaign_schema
from modetune.flows.cli.main import app

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
CORE_LIBRARIES = {"modetune", "numpy", "scipy", "h5py", "pypardiso", "pymetis", "cffi", "filelock"}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("modetune", *(parts[:-1] if parts[-1] == "__init__" else parts)))


MODULES = {
    module_name(path): path for part in PARTS for path in sorted((ROOT / part).rglob("*.py"))
}


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file's syntax tree."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))))


@cache
def imports(path: Path, module: str = "") -> set[str]:
    """Full names of everything a file imports, wherever in it; relative ones resolved.

    module: its name, where it does not stand in the house.
    """
    found: set[str] = set()
    package = (module or module_name(path)).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    for node in nodes(path):
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


#: What stands above what in flows: a room imports those to the right of it, at any distance; rooms
#: that stand together do not import each other.
FLOWS = (
    ("cli", "api"),
    ("server",),
    ("studies",),
    ("updating",),
    ("diagnosis", "jobs"),
    ("report",),
    ("campaign",),
    ("responses", "extras"),
)
#: Rooms that know several solvers: a translation from one to another, the table of all, and the
#: reading of what any program left.
KNOW_SOLVERS = {"adapters.test_files", "adapters.translation", "flows.campaign"}
Arrows = dict[str, set[str]]


def room_of(module: str, folder: str) -> str | None:
    """The direct child of a folder that a module is, or lies in."""
    _, _, inside = module.partition(f"modetune.{folder}.")
    return inside.split(".")[0] or None


def arrows(imported: dict[str, set[str]], folder: str) -> Arrows:
    """The rooms of a folder that each of its rooms imports; imported: names, by module."""
    found: Arrows = {}
    for module, names in imported.items():
        if room := room_of(module, folder):
            there = (room_of(known, folder) for name in names if (known := module_of(name)))
            found.setdefault(room, set()).update(other for other in there if other)
    return {room: there - {room} for room, there in found.items()}


def ring(found: Arrows) -> list[str]:
    """Rooms that import each other, the first again at the end; none where there are none."""
    try:
        graphlib.TopologicalSorter(found).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """What each module imports."""
    return {module: imports(path) for module, path in MODULES.items()}


@pytest.mark.parametrize("folder", ["core", "adapters", "flows", "flows.studies"])
def test_rooms_import_one_way(imported: dict[str, set[str]], folder: str) -> None:
    found = arrows(imported, folder)
    assert len(found) > 5  # the folder was read
    assert ring(found) == []


def test_flows_stand_in_their_order(imported: dict[str, set[str]]) -> None:
    level = {room: place for place, rooms in enumerate(FLOWS) for room in rooms}
    found = arrows(imported, "flows")
    assert set(found) == set(level)
    wrong = [
        (room, other) for room in found for other in found[room] if level[other] <= level[room]
    ]
    assert wrong == []


def test_a_ring_is_found_wherever_the_import_stands(
    tmp_path: Path, imported: dict[str, set[str]]
) -> None:
    planted = tmp_path / "planted.py"
    planted.write_text("def late():\n    from modetune.flows.updating import loop\n")
    names = imports(planted, "modetune.flows.campaign.planted")
    assert names == {"modetune.flows.updating.loop"}
    found = ring(arrows({**imported, "modetune.flows.campaign.planted": names}, "flows"))
    assert {"campaign", "updating"} <= set(found)


def test_only_a_translation_and_the_table_of_solvers_know_two_solvers(
    imported: dict[str, set[str]],
) -> None:
    known: dict[str, set[str]] = {}
    for module, names in imported.items():
        rooms = {room_of(name, "adapters") for name in names} & {"nastran", "calculix"}
        known.setdefault(".".join(module.split(".")[1:3]), set()).update(filter(None, rooms))
    both = {room for room, solvers in known.items() if len(solvers) == 2}
    assert both <= KNOW_SOLVERS


def test_a_class_name_has_one_meaning() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


#: Parts that several studies have; updating has a record, too.
PARTS_OF_STUDIES = {"study", "request", "record", "figures", "summary"}


def test_files_share_a_name_only_as_parts_of_one_seam() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        _, part, *rooms = module.split(".")
        # Solvers share a seam; a command has the name of its study and of the work that it starts.
        if part not in ("core", "flows") or rooms[:1] == ["cli"] or path.name == "__init__.py":
            continue
        if rooms[-1] not in {*PARTS_OF_STUDIES, "update"}:
            homes.setdefault(f"{part} {rooms[-1]}", []).append(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


def messages(path: Path) -> set[str]:
    """The sentences of a file: its texts with a space, docstrings left out."""
    docs = {
        id(node.value)
        for node in nodes(path)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    return {
        node.value
        for node in nodes(path)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if " " in node.value and id(node) not in docs
    }


def words(text: str) -> set[str]:
    return set(re.findall(r"\w+", text))


def test_core_names_no_command_no_option_and_no_campaign_key() -> None:
    keys = set(re.findall(r'"(\w+_\w+)"', json.dumps(campaign_schema())))
    assert {"frequency_weight", "hold_out", "finite_difference"} <= keys
    group: Any = typer.main.get_command(app)
    named = re.compile(rf"\bmodetune ({'|'.join(group.commands)})\b|(?<![-\w])--[a-z]")
    wrong = []
    for path in sorted((ROOT / "core").rglob("*.py")):
        texts = [text for text in messages(path) if "`" in text or keys & words(text)]
        # Comments and docstrings, too, name no command and no option.
        text = path.read_text(encoding="utf-8").replace("modetune store entry", "")  # a title
        texts += [found[0] for found in named.finditer(text)]
        wrong += [f"{path.relative_to(ROOT)}: {text}" for text in texts]
    assert wrong == []


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
    """What a wheel is built from, links as links; what runs leave in the folders stays out, but
    byte code comes along: its sources keep their times, and to compile them takes seconds."""
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    ignore = shutil.ignore_patterns(".*", "runs")
    for name in ("src", *PARTS):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=ignore)


def test_a_wheel_built_from_the_sdist_holds_every_module_and_runs(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="the build backend is not installed")
    source, out, place = tmp_path / "source", tmp_path / "out", tmp_path / "installed"
    source.mkdir()
    copy_of_sources(source)
    links = [path for path in (source / "src" / "modetune").iterdir() if path.is_symlink()]
    assert len(links) == len(PARTS)
    for link in links:  # a clone on Windows has their text
        target = link.readlink()
        link.unlink()
        link.write_text(str(target))
    python = (sys.executable, "-m")
    succeeds(*python, "build", "--no-isolation", "--outdir", str(out), str(source))
    (sdist,) = out.glob("modetune-*.tar.gz")
    with tarfile.open(sdist) as files:
        assert not [item.name for item in files if item.issym() or item.islnk()]
    (wheel,) = out.glob("modetune-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    wanted = {f"modetune/{path.relative_to(ROOT).as_posix()}" for path in MODULES.values()}
    # Templates, styles and scripts of the report and of `view` are data of the package.
    wanted |= {
        f"modetune/{path.relative_to(ROOT).as_posix()}"
        for path in (ROOT / "flows").rglob("*")
        if path.suffix in (".html", ".css", ".js")
    }
    assert wanted - held == set()
    assert not [name for name in held if name.endswith(".pyc")]
    assert {"modetune/__init__.py", "modetune/py.typed"} <= held

    options = ("--quiet", "--no-deps", "--no-index", "--no-compile", "--target", str(place))
    succeeds(*python, "pip", "install", *options, str(wheel))
    where = "import modetune; print(modetune.__file__)"
    environment = os.environ | {"PYTHONPATH": str(place)}
    told = succeeds(sys.executable, "-c", where, cwd=tmp_path, env=environment)
    assert Path(told.strip()) == place / "modetune" / "__init__.py"
    # The case's files, and the templates of the report, come with the package.
    case = (*python, "modetune.configs.cases", "six_mass", ".")
    succeeds(*case, cwd=tmp_path, env=environment)
    update = (*python, "modetune", "update", "campaign.yaml", "--set", "update.starts=1")
    assert "converged" in succeeds(*update, cwd=tmp_path, env=environment)
    assert (tmp_path / "runs" / "six-mass" / "report.html").is_file()


def succeeds(*command: str, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    """The standard output of a command that must end well."""
    ended = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=env, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout
