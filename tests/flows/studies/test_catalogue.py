"""The studies: command, Python verb and flow follow from one definition and agree."""

from __future__ import annotations

import ast
import collections.abc
import inspect
import json
import shlex
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_overloads, get_type_hints

import pytest
import typer
from pydantic import create_model
from typer.testing import CliRunner

import modetune
from modetune.core.errors import CampaignError
from modetune.core.updating.direct_update import Filling as CoreFilling
from modetune.flows import api
from modetune.flows.cli.command import command_of
from modetune.flows.cli.identify import identify
from modetune.flows.cli.init import init
from modetune.flows.cli.main import command_line
from modetune.flows.studies.catalogue import STUDIES, find_study, shell_command
from modetune.flows.studies.direct.request import Filling
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import Study
from modetune.flows.updating.display import ConsoleProgress
from modetune.flows.updating.forecast import Unwatched

#: Where studies are defined.
FOLDER = Path(inspect.getfile(Study)).parent
#: A value of each type of JSON.
VALUES: dict[Any, Any] = {bool: True, int: 3, float: 0.5, str: "text"}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What the doors ask the engine for, which runs nothing."""
    found: list[dict[str, Any]] = []

    def carried_out(
        study: Study, parameters: Mapping[str, Any], progress: object, **more: Any
    ) -> StudyResult:
        found.append({"study": study, "parameters": parameters, "progress": progress, **more})
        return StudyResult("found", "", {})

    monkeypatch.setattr("modetune.flows.api.carried_out", carried_out)
    monkeypatch.setattr("modetune.flows.server.run.carried_out", carried_out)
    return found


def typed(name: str, *words: str) -> int:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command_of(find_study(name)))
    return CliRunner().invoke(app, list(words), catch_exceptions=False).exit_code


def filled(study: Study) -> dict[str, Any]:
    """A value for every parameter of a study, of the types that its flow takes."""
    values = {}
    for item in study.fields:
        members = [one for one in get_args(item.json_kind) if one is not type(None)]
        member = members[0] if members else item.json_kind
        if get_origin(item.json_kind) is list:
            values[item.name] = [1, 2] if member is int else ["a", "b"]
        else:
            values[item.name] = item.choices[-1] if item.choices else VALUES[member]
    return values


def test_each_study_is_defined_once_below_its_name() -> None:
    assert [find_study(name).name for name in STUDIES] == list(STUDIES)
    defined = {
        path.relative_to(FOLDER).with_suffix("").as_posix().replace("/", ".")
        for path in FOLDER.rglob("*.py")
        if "\n@study(" in path.read_text()
    }
    assert defined == {place for place, _ in STUDIES.values()}
    assert all(place in (name, f"{name}.study") for name, (place, _) in STUDIES.items())


#: What `update` takes in Python alone: functions, and the campaign of one that is a model.
FUNCTIONS = {"model", "test", "parameters", "name", "version", "dofs", "responses", "on_iteration"}


@pytest.mark.parametrize("name", STUDIES)
def test_command_verb_and_flow_have_the_same_parameters_and_defaults(
    name: str, calls: list[dict[str, Any]]
) -> None:
    study = find_study(name)
    flow = {item.name for item in study.parameters}
    first = study.fields[0].name
    options = set(inspect.signature(command_of(study)).parameters)
    assert options - {"no_prefect", "as_json"} == flow
    verb = getattr(modetune, name)
    keywords = set(inspect.signature(verb).parameters) - {"progress", "prefect"}
    if name == "update":
        keywords -= FUNCTIONS
    if name == "check":
        keywords = keywords - {"run"} | {"no_run"}
    assert {first if item == "campaign" else item for item in keywords} == flow

    assert typed(name, "chain.yaml") == 0
    assert verb("chain.yaml") == "found"
    by_command, by_verb = (study.checked(call["parameters"]) for call in calls)
    assert by_command == by_verb
    assert by_command == study.checked({first: by_command[first]})


def hints_of(described: Any) -> dict[str, Any]:
    """Types of a verb's arguments, with the names that only type checkers import."""
    names = dict(vars(api))
    for node in ast.walk(ast.parse(inspect.getsource(api))):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("modetune"):
            module = import_module(str(node.module))
            names |= {item.name: getattr(module, item.name) for item in node.names}
    return get_type_hints(described, names, names)


def members(kind: Any) -> set[Any]:
    """The types of a union; a type alone otherwise."""
    return set(get_args(kind)) if get_origin(kind) in (Union, UnionType) else {kind}


@pytest.mark.parametrize("name", STUDIES)
def test_the_explicit_signature_of_a_verb_has_the_types_of_the_request(name: str) -> None:
    verb = getattr(modetune, name)
    hints, given = hints_of(verb), inspect.signature(verb).parameters
    for item in find_study(name).fields:
        if item.name not in hints:  # the campaign, and `no_run`, which is the opposite of `run`
            assert item.name in ("campaign_file", "model", "no_run"), item.name
            continue
        accepted = members(hints[item.name])
        several = get_origin(item.json_kind) is list
        if item.choices:
            literal = next(one for one in accepted if get_origin(one) is Literal)
            assert get_args(literal) == item.choices, item.name
        elif item.is_path:
            assert {str, Path} <= accepted, item.name
        elif several:
            origins = {get_origin(one) for one in accepted}
            assert origins & {collections.abc.Sequence, collections.abc.Mapping}, item.name
        else:
            scalars = {bool, int, float, str}
            assert scalars & accepted == scalars & members(item.kind), item.name
        if item.default is not item.signature.empty and not several:
            optional = type(None) in members(item.kind)
            assert (type(None) in accepted) == optional, item.name
            default = given[item.name].default or None
            assert default == (
                str(item.default) if item.is_path and item.default else item.default or None
            ), item.name


def test_the_typed_forms_of_check_have_the_arguments_of_check() -> None:
    whole = inspect.signature(modetune.check).parameters
    options, hints = hints_of(api.CheckKeywords), hints_of(api.check)
    plain, compared = (set(inspect.signature(one).parameters) for one in get_overloads(api.check))
    assert plain | set(options) | {"record", "fail_on"} == set(whole) | {"options"}
    assert compared | set(options) == set(whole) | {"options"}
    assert {name: hints[name] for name in options} == options


def test_only_public_names_are_listed() -> None:
    assert dir(modetune) == sorted([*modetune.__all__, "__version__"])


@pytest.mark.parametrize(
    ("command", "verb", "files"),
    [(init, modetune.init, "test"), (identify, modetune.identify, "frfs")],
)
def test_a_verb_without_a_study_has_the_options_of_its_command(
    command: Any, verb: Any, files: str
) -> None:
    options, keywords = (set(inspect.signature(one).parameters) for one in (command, verb))
    assert keywords - {"settings", "test"} == options - {"as_json", files}


@pytest.mark.parametrize("name", STUDIES)
def test_parameters_survive_json(name: str) -> None:
    study = find_study(name)
    checked = study.checked(filled(study))
    assert study.checked(json.loads(json.dumps(checked))) == checked
    paths = [checked[item] for item in study.path_parameters]
    assert all(
        Path(path).is_absolute()
        for one in paths
        for path in (one if isinstance(one, list) else [one])
    )


@pytest.mark.parametrize("name", STUDIES)
def test_a_command_line_gives_back_the_parameters(
    name: str, calls: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    study = find_study(name)
    first = study.fields[0].name
    for parameters in (filled(study), {first: filled(study)[first]}):
        checked = study.checked(parameters)
        program, *words = shlex.split(shell_command(study, checked))
        assert program == "modetune"
        with monkeypatch.context() as elsewhere:
            elsewhere.chdir(tmp_path)
            app = command_line(*words[:2])
            assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
            assert study.checked(calls[-1]["parameters"]) == checked


@pytest.mark.parametrize("name", STUDIES)
def test_a_form_shows_the_help_and_the_choices(name: str) -> None:
    study = find_study(name)
    fields: dict[str, Any] = {
        item.name: (item.annotation, ... if item.default is item.empty else item.default)
        for item in study.parameters
    }
    schema = create_model(name, **fields).model_json_schema()["properties"]
    assert all(described["description"] for described in schema.values())
    for item in study.fields:
        shown = json.dumps(schema[item.name])
        assert all(f'"{choice}"' in shown for choice in item.choices)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"metod": "morris"}, "screen has no parameter 'metod'; did you mean method?"),
        ({"as_json": True}, "screen has no parameter 'as_json'"),
        ({"method": "mories"}, "screen: method 'mories': expected one of local, morris, sobol"),
        ({"points": "40"}, "screen: points '40': expected a whole number"),
        ({"points": True}, "screen: points True: expected a whole number"),
        ({"seed": -1}, "screen: seed -1: expected a whole number from 0"),
        ({"settings": "a=b"}, "screen: settings 'a=b': expected a list of texts"),
        ({"out": 3}, "screen: out 3: expected a text"),
    ],
)
def test_wrong_parameters_are_refused_in_a_sentence(given: dict[str, Any], said: str) -> None:
    with pytest.raises(CampaignError) as refused:
        find_study("screen").checked({"campaign_file": "chain.yaml", **given})
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_all_problems_are_named_at_once() -> None:
    with pytest.raises(CampaignError) as refused:
        find_study("check").checked({"frequency_band": float("nan"), "mac_band": 2.0})
    assert str(refused.value).splitlines() == [
        "check: campaign_file is missing",
        "check: frequency_band nan: expected a number from 0",
        "check: mac_band 2.0: expected a number from 0 to 1",
    ]


def test_the_paths_of_a_study_are_all_files_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    study = find_study("reduce")
    given = {"model": "wing.inp", "test": ["a.unv", "b.csv"], "masters": "1.x,2.x"}
    named = [tmp_path / name for name in ("wing.inp", "a.unv", "b.csv")]
    assert study.paths(study.checked(given)) == named
    (tmp_path / "masters.txt").write_text("1.x\n")
    parameters = study.checked({**given, "masters": "masters.txt"})
    assert set(study.paths(parameters)) == {*named, tmp_path / "masters.txt"}
    many = ",".join(f"{node}.x" for node in range(1, 500))  # longer than a file name may be
    assert study.checked({**given, "masters": many})["masters"] == many


def test_a_study_without_a_solver_needs_no_server(tmp_path: Path) -> None:
    check, correlate = find_study("check"), find_study("correlate")
    file = {"campaign_file": "chain.yaml"}
    assert check.solves(file)
    assert not check.solves({**file, "no_run": True})
    assert not check.solves({**file, "against": "old.h5", "record": "new.h5"})
    test, campaign = tmp_path / "test.csv", tmp_path / "chain.yaml"
    test.write_text("")
    campaign.write_text("")
    assert not correlate.solves({"first": [test], "second": [test]})
    assert correlate.solves({"first": [test], "second": [campaign]})


@pytest.mark.parametrize(
    ("variable", "prefect", "door"),
    [("", False, "find"), ("0", True, "start"), ("1", True, "off"), ("true", False, "off")],
)
def test_a_verb_starts_no_server_unless_asked(
    variable: str, prefect: bool, door: str, calls: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_NO_PREFECT", variable)
    modetune.modes("chain.yaml", prefect=prefect)
    modetune.modes("chain.yaml", prefect=prefect, progress=True)
    assert [call["prefect"] for call in calls] == [door, door]
    assert [type(call["progress"]) for call in calls] == [Unwatched, ConsoleProgress]


def test_a_command_starts_a_server_unless_told_otherwise(
    calls: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MODETUNE_NO_PREFECT")
    typed("modes", "chain.yaml")
    typed("modes", "chain.yaml", "--no-prefect")
    monkeypatch.setenv("MODETUNE_NO_PREFECT", "1")
    typed("modes", "chain.yaml")
    assert [call["prefect"] for call in calls] == ["start", "off", "off"]


def test_fillings_are_those_of_the_correction() -> None:
    assert get_args(Filling) == get_args(CoreFilling)
