"""The documentation: it builds, needs no network, and says what the program does."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import pytest
import typer
import yaml
from pydantic import ValidationError

from modetune.adapters.solver import Deck, Program
from modetune.core import errors
from modetune.flows.campaign.schema import CampaignFile, campaign_schema
from modetune.flows.cli.main import app
from tests.command_line import run_command

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SCHEMA = DOCS / "campaign.schema.json"
PAGES = sorted(DOCS.glob("*.md"))
#: Texts outside of docs/, whose links the site's build does not see.
OUTSIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
CAMPAIGNS = sorted(
    path
    for path in (ROOT / "configs").rglob("*.yaml")
    if re.search(r"^parameters:", path.read_text(), re.MULTILINE)
)
#: Elements whose address a browser fetches by itself; those of links it does not.
FETCHED = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src"}


def tool(name: str) -> ModuleType:
    """A program of tools/, imported from its file."""
    found = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module  # its dataclasses look themselves up
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as it is published: built with every warning an error."""
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_built_and_none_has_a_broken_link(site: Path) -> None:
    assert {path.stem for path in site.glob("*.html")} == {page.stem for page in PAGES} | {"404"}


class Fetched(HTMLParser):
    """Addresses that a browser fetches when it opens a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(FETCHED.get(tag, ""))
        if address and dict(attrs).get("rel") not in ("canonical", "prev", "next"):
            self.addresses.append(address)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    words = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"[\s-]+", "-", each) for each in words}


@pytest.mark.parametrize("page", OUTSIDE, ids=lambda page: page.name)
def test_every_link_outside_of_the_site_leads_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    for link in links:
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


#: Names of docs pages in code, comments, messages and configurations.
NAMED = re.compile(r"\bdocs/([\w-]+\.md)(?:#([\w-]+))?")


def test_every_page_that_the_tree_names_exists() -> None:
    folders = ("core", "adapters", "flows", "configs", "tests", "tools", "benchmarks")
    files = [
        path
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".js", ".html", ".yaml", ".yml", ".sh")
    ]
    files += [*OUTSIDE, ROOT / "Makefile", ROOT / "pyproject.toml", ROOT / "mkdocs.yml"]
    named = [(path, *found) for path in files for found in NAMED.findall(path.read_text())]
    assert len(named) > 10
    for path, name, anchor in named:
        assert (DOCS / name).is_file(), (path, name)
        assert not anchor or anchor in anchors(DOCS / name), (path, name, anchor)


def test_no_page_fetches_anything_from_the_network(site: Path) -> None:
    for page in site.glob("*.html"):
        fetched = Fetched(page.read_text()).addresses
        assert fetched, page
        assert not [address for address in fetched if "//" in address], page
    for style in site.rglob("*.css"):
        assert not re.findall(r"url\(['\"]?(?:https?:)?//|@import", style.read_text()), style


def test_equations_are_drawn_while_the_site_is_built(site: Path) -> None:
    text = (site / "theory.html").read_text()
    written = (DOCS / "theory.md").read_text()
    n_equations = written.count("$$") // 2 + len(re.findall(r"(?<!\$)\$[^$\n]+\$(?!\$)", written))
    assert text.count('<svg role="img"') == n_equations > 40
    assert "arithmatex" not in text


def test_the_code_of_the_solver_page_is_that_of_its_example(site: Path) -> None:
    text = re.sub(r"<[^>]+>", "", (site / "adding-a-solver.html").read_text())
    assert "class RodDeck" in text
    assert "class RodProgram" in text
    assert "8&lt;" not in text


def test_an_equation_that_cannot_be_set_is_named_with_its_page() -> None:
    from mkdocs.exceptions import PluginError

    content = r'<p>so <span class="arithmatex">\(\nosuchthing x\)</span></p>'
    with pytest.raises(PluginError, match=r"theory\.md: the equation '.*nosuchthing x'"):
        tool("equations").on_page_content(content, page="theory.md")


def test_pages_made_from_the_program_are_what_it_says_now() -> None:
    assert tool("reference_pages").stale() == []  # else: python tools/reference_pages.py


def test_a_stale_page_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = tool("reference_pages")
    monkeypatch.setattr(pages, "DOCS", tmp_path)
    for path, text in pages.pages().items():
        path.write_text(text)
    assert pages.stale() == []
    (tmp_path / "keys.md").write_text("# Campaign keys\n")
    assert pages.stale() == [tmp_path / "keys.md"]


def test_every_campaign_key_has_a_meaning() -> None:
    rows = re.findall(r"^\| `(\S+)` \|(.*)\|$", (DOCS / "keys.md").read_text(), re.MULTILINE)
    assert len(rows) > 60
    assert [key for key, cells in rows if not cells.rpartition("|")[2].strip()] == []


@pytest.mark.parametrize("path", CAMPAIGNS, ids=lambda path: path.name)
def test_campaigns_hold_to_the_schema_that_their_first_line_names(path: Path) -> None:
    first, _, text = path.read_text().partition("\n")
    named = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert named is not None
    assert (path.parent / named[1]).resolve() == SCHEMA
    validator().validate(plain(text))


@cache
def validator() -> jsonschema.Draft202012Validator:
    """What an editor checks a campaign with."""
    schema = json.loads(SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def plain(text: str) -> Any:
    """A campaign as JSON would have it."""
    return json.loads(json.dumps(yaml.safe_load(text)))


GOOD: dict[str, Any] = {
    "name": "wing",
    "model": {"deck": "wing.inp", "units": "mm-t-s"},
    "test": {"modes": "wing.csv"},
    "parameters": [{"name": "E", "quantity": "youngs_modulus", "material": "ALU"}],
}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("name",), "a name with blanks"),
        (("modal",), {}),
        (("model", "units"), "furlongs"),
        (("model", "deck"), 3),
        (("model", "generator"), {"case": "garteur"}),  # no key
        (("test",), {}),
        (("parameters",), []),
        (("parameters", 0, "quantity"), "weight"),
        (("parameters", 0, "quantity"), "matrix_factor"),  # of a material
        (("parameters", 0, "part"), "wing"),  # and a material
        (("parameters", 0, "bounds"), [0.5]),
        (("update",), {"e2": -1.0}),
        (("update",), {"regularisation": "largest"}),
        (("run",), {"retries": 11}),
        (("run",), {"licences": {"nastran": 0}}),
    ],
)
def test_what_the_reader_refuses_an_editor_shows(place: tuple[Any, ...], value: Any) -> None:
    validator().validate(GOOD)
    CampaignFile.model_validate(GOOD)
    wrong = json.loads(json.dumps(GOOD))
    owner = wrong
    for key in place[:-1]:
        owner = owner[key]
    owner[place[-1]] = value
    with pytest.raises(ValidationError):
        CampaignFile.model_validate(wrong)
    with pytest.raises(jsonschema.ValidationError):
        validator().validate(wrong)


@pytest.mark.parametrize(
    "section",
    [
        {"run": {"retries": 2}},
        {"run": {"retries": {"timeout": 0}, "licences": {"nastran": 2}}},
        {"update": {"regularisation": "l_curve"}},
        {"store": None},
    ],
)
def test_what_the_reader_takes_an_editor_takes(section: dict[str, Any]) -> None:
    CampaignFile.model_validate({**GOOD, **section})
    validator().validate({**GOOD, **section})


def schema_command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return run_command(ROOT, "files", "schema", *arguments)


def test_the_schema_command_prints_and_writes_the_same(tmp_path: Path) -> None:
    printed = schema_command()
    assert json.loads(printed.stdout) == campaign_schema()
    written = schema_command("--out", str(tmp_path / "new" / "c.json"))
    assert written.returncode == 0
    assert "# yaml-language-server: $schema=c.json" in written.stdout
    assert (tmp_path / "new" / "c.json").read_text() == printed.stdout


def test_a_schema_that_cannot_be_written_is_told_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    told = schema_command("--out", str(tmp_path / "file" / "c.json"))
    assert told.returncode == 5  # the place cannot be written
    assert told.stderr.startswith("modetune: ")
    assert "Traceback" not in told.stderr


def test_every_error_is_explained_with_its_exit_code_and_its_place_in_the_tree() -> None:
    text = (DOCS / "errors.md").read_text()
    rows = re.findall(r"^\| ((?:· )*)`(\w+)` \| (\d+) \|", text, re.MULTILINE)
    told = {name: (len(depth) // 2, int(code)) for depth, name, code in rows}
    classes = [
        found
        for _, found in inspect.getmembers(errors, inspect.isclass)
        if issubclass(found, errors.ModetuneError)
    ]
    # Exception and its own bases stand above ModetuneError, which is at depth 0.
    above = len(errors.ModetuneError.__mro__)
    assert told == {
        found.__name__: (len(found.__mro__) - above, found.exit_code) for found in classes
    }
    assert {found.exit_code for found in classes} <= {
        int(code)
        for code in re.findall(r"^\| (\d+) \|", (DOCS / "commands.md").read_text(), re.MULTILINE)
    }


def test_every_member_of_the_solver_seam_is_explained() -> None:
    text = (DOCS / "adding-a-solver.md").read_text()
    inherited = {"problems", "deck_value"}  # they follow from `numbers`
    members = [
        name
        for side in (Deck, Program)
        for name in vars(side)
        if not name.startswith("_") and name not in inherited
    ]
    assert len(members) > 12
    assert [name for name in members if f"`{name}" not in text] == []


def commands(group: Any, above: tuple[str, ...] = ()) -> dict[tuple[str, ...], set[str]]:
    """Options of every command, by the words that name it."""
    found: dict[tuple[str, ...], set[str]] = {}
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            found |= commands(command, (*above, name))
        else:
            found[(*above, name)] = {option for item in command.params for option in item.opts}
    return found


@pytest.mark.parametrize("page", [*PAGES, *OUTSIDE[:2]], ids=lambda page: page.name)
def test_every_command_line_of_the_pages_is_one(page: Path) -> None:
    known = commands(typer.main.get_command(app))
    blocks = re.findall(r"^```\w*\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`(modetune [a-z][^`\n]*)`", page.read_text())
    for line in lines:
        unquoted = re.sub(r'"[^"]*"', "VALUE", line)  # what is in quotes is a value
        words = unquoted.partition("#")[0].replace("[", " ").replace("]", " ").split()
        if words[:1] != ["modetune"] or words[1:2] in ([], ["COMMAND"], ["--help"]):
            continue
        if words[1].endswith(":"):
            continue  # what modetune says, not what it is told
        name = tuple(words[1:3]) if tuple(words[1:3]) in known else (words[1],)
        if words[2:3] == ["--help"] and words[1] in {group for group, *more in known if more}:
            continue
        assert name in known, line
        options = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert options <= known[name] | {"--help"}, line


def test_every_command_is_in_the_introduction_of_its_page() -> None:
    page = (DOCS / "commands.md").read_text()
    introduction = page[: page.index("\n## ")]
    known = commands(typer.main.get_command(app))
    shown = re.findall(r"^modetune (\w+)(?: (\w+))?", introduction, re.MULTILINE)
    assert {words if words in known else words[:1] for words in shown} == set(known)


#: Paths of the repository in backticks; capitals stand for a name.
PATHS = re.compile(
    r"`((?:core|adapters|flows|configs|tests|benchmarks|tools|docs|src)/[\w./-]*[\w/])`"
)


@pytest.mark.parametrize("page", [*PAGES, *OUTSIDE[:2]], ids=lambda page: page.name)
def test_every_path_and_program_of_the_pages_exists(page: Path) -> None:
    text = page.read_text()
    for path in PATHS.findall(text):
        if re.search(r"\b[A-Z]{3,}\b", path):
            continue
        assert (ROOT / path).exists() or (ROOT / f"{path}.py").is_file(), path
    for script in re.findall(r"\bpython ((?:benchmarks|tools)/\w+\.py)", text):
        assert (ROOT / script).is_file(), script
    for module in re.findall(r"\bpython -m ((?:modetune|benchmarks)[\w.]*)", text):
        name = module.rstrip(".")
        if importlib.util.find_spec(name) is None:
            raise AssertionError(module)
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"^make (\w+)|`make (\w+)", text, re.MULTILINE):
        assert re.search(rf"^{''.join(target)}:", makefile, re.MULTILINE), target


#: Not modules: the group of entry points by which packages bring solvers, an event of Prefect and
#: its resource.
OTHER_NAMES = {
    "modetune.solvers",
    "modetune.structure",
    "modetune.structure.NAME",
    "modetune.structure.changed",
}


@pytest.mark.parametrize("page", [*PAGES, *OUTSIDE[:2]], ids=lambda page: page.name)
def test_every_python_name_of_the_pages_exists(page: Path) -> None:
    text = page.read_text()
    names = set(re.findall(r"`(modetune(?:\.\w+)+)", text)) - OTHER_NAMES
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("modetune"):
                names |= {f"{node.module}.{imported.name}" for imported in node.names}
    described = re.findall(r"`(\w+)\S*` of `(modetune\.[\w.]+)`", text)
    names |= {f"{module}.{name}" for name, module in described}
    for name in names:
        assert resolved(name), name


def resolved(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    module, _, attribute = name.rpartition(".")
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        return bool(module) and hasattr(importlib.import_module(module), attribute)
    return True


def test_the_glossary_has_one_meaning_for_a_term() -> None:
    rows = re.findall(r"^\| ([^|]+) \|", (DOCS / "glossary.md").read_text(), re.MULTILINE)
    terms = [term.strip() for row in rows for term in row.split(",")]
    terms = [term for term in terms if term not in ("term", "---")]
    assert len(terms) > 50
    assert sorted(terms) == sorted(set(terms))


def test_the_first_campaign_is_that_of_the_lab() -> None:
    page = (DOCS / "first-campaign.md").read_text()
    text = re.search(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert text is not None
    # tests/cases/test_lab.py takes this one from the lab's file to a report.
    lab = yaml.safe_load((ROOT / "configs" / "garteur" / "lab.yaml").read_text())
    deck = {"model": lab["model"] | {"deck": "aircraft.inp"}}  # as a lab's customer calls it
    assert yaml.safe_load(text[1]) == lab | {"name": "first"} | deck
    validator().validate(plain(text[1]))
