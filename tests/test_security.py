"""What modetune must never do: listen to the network, use a shell, unpickle, leave its folders, or
tell secrets."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.core.errors import CampaignError
from modetune.core.parameters import Parameter
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs import prefect_server as process
from tests.command_line import run_command
from tests.test_structure import MODULES, ROOT, nodes

SIX_MASS = ROOT / "configs" / "six_mass"
SECRET = "s3cr3t-" + "0123456789abcdef"
#: Where a secret stands in an environment, PREFECT_API_URL among it: a dead server's, port 9.
SECRETS = {
    "PREFECT_API_KEY": SECRET,
    "PREFECT_API_AUTH_STRING": f"admin:{SECRET}",
    "PREFECT_API_DATABASE_CONNECTION_URL": f"postgresql+asyncpg://modetune:{SECRET}@db/prefect",
    "LM_LICENSE_TOKEN": SECRET,
}


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A campaign of six masses that runs in a second or two."""
    folder = tmp_path / "campaign"
    shutil.copytree(SIX_MASS, folder, ignore=shutil.ignore_patterns("__pycache__", ".*", "*.py"))
    return folder / "campaign.yaml"


def run(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return run_command(folder, *arguments, MODETUNE_HOME=str(folder / "home"), **environment)


# The network


def test_an_address_has_no_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_API_URL", f"https://me:{SECRET}@prefect.example/api")
    monkeypatch.delenv("PREFECT_API_AUTH_STRING", raising=False)
    server = process.configured_server()
    assert server is not None
    assert (server.address.url, server.login) == ("https://prefect.example/api", f"me:{SECRET}")
    assert SECRET not in server.describe("does not answer") + server.pages


# The code

#: Calls that read or run what a file says. None of them is allowed anywhere.
FORBIDDEN_CALLS = {
    "os.system", "os.popen", "os.spawnl", "os.spawnv", "os.spawnvp", "subprocess.getoutput",
    "subprocess.getstatusoutput", "eval", "exec", "compile", "__import__", "yaml.load",
    "yaml.full_load", "yaml.unsafe_load", "yaml.load_all", "yaml.unsafe_load_all", "builtins.eval",
    "builtins.exec", "asyncio.create_subprocess_shell", "np.fromregex", "numpy.load",
    "tempfile.mktemp",
}  # fmt: skip
#: Modules that build objects from bytes.
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "joblib", "shelve", "marshal", "imp",
                     "cloudpickle", "pdb"}  # fmt: skip
#: Yaml's only door: data alone. `_Loader` in yaml_file.py is SafeLoader.
UNSAFE_LOADERS = {"Loader", "FullLoader", "UnsafeLoader", "BaseLoader", "CLoader"}


@cache
def calls(path: Path) -> list[tuple[str, ast.Call]]:
    return [(dotted(node.func), node) for node in nodes(path) if isinstance(node, ast.Call)]


def dotted(node: ast.expr) -> str:
    """The name of what is called; of what another call returned, from the dot on."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def keyword(call: ast.Call, name: str) -> str | None:
    return next((ast.unparse(item.value) for item in call.keywords if item.arg == name), None)


def test_there_is_no_shell_anywhere() -> None:
    wrong = []
    for path in MODULES.values():
        for name, call in calls(path):
            shell = keyword(call, "shell")
            if shell not in (None, "False"):
                wrong.append(f"{path}, line {call.lineno}: shell={shell}")
            starts = name.startswith("subprocess.") or name == "Popen"
            first = call.args[0] if call.args else None
            if starts and isinstance(first, ast.Constant | ast.JoinedStr):
                wrong.append(f"{path}, line {call.lineno}: {name} of a text")
    assert wrong == []


def test_nothing_runs_or_unpickles_what_a_file_says() -> None:
    wrong = []
    for path in MODULES.values():
        wrong += [
            f"{path}, line {call.lineno}: {name}"
            for name, call in calls(path)
            if name in FORBIDDEN_CALLS
        ]
        for node in nodes(path):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            wrong += [
                f"{path}, line {node.lineno}: import {name}"  # type: ignore[attr-defined]  # imports have one
                for name in names
                if name.partition(".")[0] in FORBIDDEN_MODULES
            ]
            if isinstance(node, ast.Attribute) and dotted(node.value) == "yaml":
                if node.attr in UNSAFE_LOADERS:
                    wrong.append(f"{path}, line {node.lineno}: yaml.{node.attr}")
    assert wrong == []


def test_arrays_from_files_are_read_without_pickles() -> None:
    loads = [
        (path, call)
        for path in MODULES.values()
        for name, call in calls(path)
        if name in ("np.load", "np.savez", "np.save")
    ]
    assert loads  # the scan sees what it is for
    wrong = [
        f"{path}, line {call.lineno}"
        for path, call in loads
        if keyword(call, "allow_pickle") != "False"
    ]
    assert wrong == []


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system [touch pwned]",
        "!!python/name:os.system",
        "!ruby/object x",
        "!!python/object/new:subprocess.Popen [[touch, pwned]]",
    ],
)
def test_a_tag_in_a_campaign_builds_nothing(
    campaign: Path, tag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(campaign.parent)
    campaign.write_text(campaign.read_text() + f"store: {tag}\n")
    with pytest.raises(CampaignError, match="not readable as YAML"):
        load_campaign(campaign)
    assert not (campaign.parent / "pwned").exists()


# Folders

ESCAPES = ["../x", "..", ".", "/tmp/x", "a/../../x", "a\\..\\x", "x\n", "", "~", "x y", "\0", "-rf",
           "$(id)", "a" * 65]  # fmt: skip


@pytest.mark.parametrize("name", ESCAPES)
def test_a_campaigns_name_cannot_leave_the_folder_of_runs(campaign: Path, name: str) -> None:
    text = campaign.read_text().replace("name: six-mass", f"name: {json.dumps(name)}")
    campaign.write_text(text)
    with pytest.raises(CampaignError, match="line"):
        load_campaign(campaign)


@pytest.mark.parametrize("name", ESCAPES)
def test_names_of_parameters_and_licences_cannot_either(campaign: Path, name: str) -> None:
    text = campaign.read_text()
    campaign.write_text(text.replace("{name: k1,", f"{{name: {json.dumps(name)},"))
    with pytest.raises(CampaignError, match="line"):
        load_campaign(campaign)
    campaign.write_text(f"{text}run: {{licences: {{{json.dumps(name)}: 1}}}}\n")
    with pytest.raises(CampaignError, match="line"):
        load_campaign(campaign)


def test_includes_from_elsewhere_do_not_take_the_updated_deck_there(tmp_path: Path) -> None:
    outside, model = tmp_path / "outside.inp", tmp_path / "model"
    model.mkdir()
    outside.write_text("*MATERIAL, NAME=ALU\n*ELASTIC\n71000., 0.3\n*DENSITY\n2.8e-9\n")
    (model / "deck.inp").write_text(
        "*NODE\n1,0,0,0\n2,1,0,0\n3,1,1,0\n4,0,1,0\n5,0,0,1\n6,1,0,1\n7,1,1,1\n8,0,1,1\n"
        "*ELEMENT, TYPE=C3D8I, ELSET=BAR\n1,1,2,3,4,5,6,7,8\n*INCLUDE, INPUT=../outside.inp\n"
        "*SOLID SECTION, ELSET=BAR, MATERIAL=ALU\n"
    )
    before = outside.read_bytes()
    parameter = Parameter("E", "youngs_modulus", "material", ("ALU",), 0.5, 2.0, 0.2)
    solver = calculix_solver(model / "deck.inp", (parameter,))
    target = tmp_path / "runs" / "x" / "updated"
    solver.deck.write_updated({"E": 1.1}, target)
    assert outside.read_bytes() == before
    written = {path for path in (tmp_path / "runs").rglob("*") if path.is_file()}
    assert len(written) == 2
    assert all(path.is_relative_to(target) for path in written)


# Secrets


def leaks(folder: Path) -> list[str]:
    return [
        str(path)
        for path in folder.rglob("*")
        if path.is_file() and SECRET.encode() in path.read_bytes()
    ]


def test_secrets_of_the_environment_are_in_no_log_deck_or_record(
    campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "CONFIGURED_PATIENCE_S", 0.1)
    dead = f"http://me:{SECRET}@127.0.0.1:9/api"
    folder = campaign.parent
    settings = ["--set", "run.keep_jobs=true", "--json"]
    for arguments in (["--no-prefect"], []):
        done = run(
            folder,
            "update",
            campaign.name,
            *arguments,
            *settings,
            MODETUNE_LOG="DEBUG",
            PREFECT_API_URL=dead,
            MODETUNE_NO_PREFECT="0",
            **SECRETS,
        )
        assert done.returncode in (0, 3), done.stderr
        assert SECRET not in done.stdout + done.stderr
        shutil.rmtree(folder / ".modetune")
    assert "does not answer" in done.stderr
    assert (folder / "runs" / "six-mass" / "campaign.h5").is_file()
    assert leaks(folder) == []


def test_secrets_are_in_no_error_either(campaign: Path) -> None:
    for arguments in (["--set", "run.timeout_s=0.001"], ["--set", "model.deck=none.yaml"]):
        done = run(
            campaign.parent,
            "update",
            campaign.name,
            "--no-prefect",
            *arguments,
            MODETUNE_LOG="DEBUG",
            **SECRETS,
        )
        assert done.returncode in (2, 4), done.stderr
        assert SECRET not in done.stdout + done.stderr
    assert leaks(campaign.parent) == []


# The threat model


def test_every_line_of_the_threat_model_has_its_tests() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ") and "](" in line]
    assert len(rows) > 15
    assert text.count("\n| ") == len(rows) + 2  # the head and the line below it
    missing = []
    for row in rows:
        links = re.findall(r"\]\((\S+) \"(\w+)\"\)", row.rpartition(" | ")[2])
        assert links, row
        assert len(links) == row.count("]("), row
        missing += [
            f"{file}: {name}"
            for file, name in links
            if not (ROOT / file).is_file() or name not in names_of_tests(ROOT / file)
        ]
    assert missing == []


@cache
def names_of_tests(file: Path) -> set[str]:
    """The tests of a file that run with every change."""
    tests = [node for node in nodes(file) if isinstance(node, ast.FunctionDef)]
    return {
        node.name
        for node in tests
        if not any("nightly" in ast.unparse(item) for item in node.decorator_list)
    }
