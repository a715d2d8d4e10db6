"""Doubts of the pre-check: each value that the page offers resolves the doubt beside it."""

from __future__ import annotations

import ast
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune import flows
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import CampaignError
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.studies.view.campaign_changes import Part, part_of
from modetune.flows.studies.view.doubts import Doubts, doubt_change, find_doubts
from tests.adapters.solved import needs_ccx
from tests.flows.report.conftest import plate_record
from tests.flows.studies.view.hook import Hook, write_hook

#: The bounds of the hook's two moduli, and what is doubtful about those of the test.
BOUNDS = "bounds: [0.5, 1.5]}"


def part(path: Path) -> Part:
    return part_of(read_yaml(path, "a campaign"))


def doubts(path: Path, solve: bool = True) -> Doubts:
    return find_doubts(load_campaign(path), part(path), None, solve, threading.Event())


def heads(found: Doubts) -> list[str]:
    """Where each doubt is, and its first words, without numbers that change with others."""
    return [f"{item.where}: {item.what[:12]}" for item, _ in found.doubts]


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The hook with a dead channel, a reversed sensor, and strange bounds."""
    hook: Hook = write_hook(tmp_path_factory.mktemp("faulty"))
    modes_file = hook.campaign.parent / "modes.csv"
    test = read_measurement([modes_file]).modes
    assert test is not None
    shapes = test.modes.mode_shapes.copy()
    shapes[0] = 0.0
    shapes[7] *= -1.0
    write_modes_csv(modes_file, test.numbers, replace(test.modes, mode_shapes=shapes), ())
    text = hook.campaign.read_text()
    foot, arm = text.index(BOUNDS), text.rindex(BOUNDS)
    text = text[:foot] + "bounds: [0.01, 30.0]}" + text[foot + len(BOUNDS) : arm]
    text += "bounds: [1.0, 1.5]}   # as in 2019" + hook.campaign.read_text()[arm + len(BOUNDS) :]
    hook.campaign.write_text(text)
    return hook.campaign


@needs_ccx
def test_every_value_that_is_offered_resolves_its_doubt(faulty: Path, tmp_path: Path) -> None:
    before = doubts(faulty, solve=False)
    assert before.unsolved  # the store has the true hook only
    found = doubts(faulty)
    assert not found.unsolved
    assert len(found.doubts) > len(before.doubts) >= 3
    text, tried = faulty.read_text(), []
    for (doubt, controls), head in zip(found.doubts, heads(found), strict=True):
        for control in controls:
            if not (control.text or control.removes):
                continue
            change = doubt_change(
                part(faulty), control.place, None if control.removes else control.text, found.places
            )
            change.write(change.base)
            assert faulty.read_text() != text
            assert "# the fifth is weak" in faulty.read_text()
            assert head not in heads(doubts(faulty)), (doubt.text, control)
            tried.append(control.key)
            faulty.write_text(text)
    assert set(tried) >= {
        "test.sensors.drop",
        "test.sensors.reverse",
        "parameters.E_foot.bounds",
        "parameters.E_arm.bounds",
        "parameters.E_arm.initial",
    }


@needs_ccx
def test_units_are_chosen_and_the_check_can_be_accepted(faulty: Path, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    shutil.copytree(faulty.parent, folder)
    path = folder / faulty.name
    deck = folder / "hook.inp"
    text = deck.read_text().replace("7.85e-9", "7850").replace("210000,", "2.1e11,")
    deck.write_text(text)  # steel in Pa and kg/m3, between nodes in mm
    found = doubts(path, solve=False)
    controls = {
        control.key: control
        for item, controls in found.doubts
        for control in controls
        if item.subject == "model"
    }
    assert "m-kg-s" in controls["model.units"].choices
    assert controls["model.units"].text == "m-kg-s"  # those of steel
    change = doubt_change(part(path), controls["model.units"].place, "m-kg-s", found.places)
    assert [line for line in change.to_json()["diff"] if line[:2] == "+m"] == [  # type: ignore[index, union-attr]  # JSON
        "+model: {deck: hook.inp, solver: calculix, units: m-kg-s, eigensolver: solver}   # S355"
    ]
    accept = controls["model.checks"]
    assert accept.text.startswith("[")
    change = doubt_change(part(path), accept.place, accept.text, found.places)
    change.write(change.base)
    assert load_campaign(path).case.accepted


@needs_ccx
def test_only_keys_that_were_offered_are_changed(faulty: Path) -> None:
    found = doubts(faulty, solve=False)
    text = faulty.read_text()
    for place in [("model", "command"), ("run", "commands", "calculix"), ("store",)]:
        with pytest.raises(CampaignError, match="no doubt offers to change"):
            doubt_change(part(faulty), place, "[sh, -c, id]", found.places)
    bounds = ("parameters", 0, "bounds")
    with pytest.raises(CampaignError, match=r"bounds"):
        doubt_change(part(faulty), bounds, "[3, 2]", found.places)
    with pytest.raises(CampaignError, match="not readable as YAML"):
        doubt_change(part(faulty), bounds, "[3, 2", found.places)
    with pytest.raises(CampaignError, match="give a value"):
        doubt_change(part(faulty), bounds, "", found.places)
    assert faulty.read_text() == text


@needs_ccx
def test_an_update_that_ended_on_a_bound_offers_a_wider_one(faulty: Path) -> None:
    low, high = (
        Parameter(name, "youngs_modulus", "material", (of,), 0.5, 1.5, 0.2)
        for name, of in (("E_foot", "FOOT"), ("E_arm", "ARM"))
    )
    record: CampaignRecord = replace(
        plate_record(), parameters=ParameterSet((low, high)), updated=np.array([0.5, 1.5])
    )
    own = part(faulty)
    found = find_doubts(load_campaign(faulty), own, record, False, threading.Event())
    offered = {
        c.key: c.text for item, cs in found.doubts for c in cs if "on its bound" in item.what
    }
    assert offered == {
        "parameters.E_foot.bounds": "[0.25, 1.5]",  # a modulus stays above zero
        "parameters.E_arm.bounds": "[0.5, 2.0]",
    }


def settings_in_code() -> set[tuple[str, ...]]:
    """The keys that findings name."""
    found: set[tuple[str, ...]] = set()
    for path in Path(flows.__path__[0]).resolve().rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            first = node.args[0] if node.args else None
            if node.func.id == "setting" and isinstance(first, ast.Constant):
                found.add(tuple(str(first.value).split(".")))
            elif node.func.id == "Setting" and isinstance(first, ast.Tuple):
                words = [item.value for item in first.elts if isinstance(item, ast.Constant)]
                if len(words) == len(first.elts):
                    found.add(tuple(map(str, words)))
    return found


def test_every_key_that_a_finding_names_is_one_of_a_campaign() -> None:
    keys = settings_in_code()
    assert len(keys) > 10
    for key in keys:
        section: Any = CampaignFile
        for name in key:
            assert name in section.model_fields, ".".join(key)
            section = section.model_fields[name].annotation
