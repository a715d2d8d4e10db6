"""The proposed campaign: the user's file with the chosen parameters, ready to run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import RunCounts
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.screen.choice import ChosenParameters, ParameterVerdict
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.proposal import proposed_name, write_proposal
from modetune.flows.studies.screen.record import Responses, Screening
from modetune.flows.studies.screen.sensitivity import LocalSensitivity
from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[4] / "configs" / "six_mass"


def screening(names: tuple[str, ...], chosen: tuple[str, ...]) -> Screening:
    """A screening that came to this choice."""
    count, none = len(names), np.zeros((0, len(names)))
    verdicts = tuple(
        ParameterVerdict(
            name,
            chosen.index(name) + 1 if name in chosen else 0,
            "helps"
            if name in chosen
            else f"collinear with {chosen[0] if chosen else '?'} "
            "(cosine +0.987): the test determines only a combination of the two, a long sentence",
        )
        for name in names
    )
    return Screening(
        name="six-mass",
        seed=1,
        solver="matrices",
        solver_version="1",
        units="m-kg-s",
        campaign_text="",
        names=names,
        deviations=np.full(count, 0.2),
        numbers=(1,),
        test_hz=np.ones(1),
        nominal_hz=np.ones(1),
        nominal_mac=np.ones(1),
        design=Design(
            "lhs", np.ones((20, count)), np.arange(20), np.zeros(count), np.ones(count), 0
        ),
        responses=Responses(
            np.ones((20, 1)), np.zeros((20, 0)), ("",) * 20, ("",) * 20, np.zeros((20, 0)), (), ()
        ),
        local=LocalSensitivity(none, none, none, none, np.zeros(0), ("",) * count, ("",) * count),
        indices=None,
        importance=np.ones(count),
        choice=ChosenParameters(verdicts, tuple(range(count)), (), ()),
        runs=RunCounts(),
        wall_s=1.0,
    )


KS = ("k1", "k2", "k3", "k4")


@pytest.fixture
def campaign_file(tmp_path: Path) -> Path:
    for name in ("campaign.yaml", "six_mass.yaml", "measured.csv"):
        shutil.copyfile(SIX_MASS / name, tmp_path / name)
    return tmp_path / "campaign.yaml"


def test_keys_that_are_numbers_stay(campaign_file: Path, tmp_path: Path) -> None:
    text = campaign_file.read_text().replace(
        "modes: measured.csv", "modes: measured.csv, pairs: {2: 2}"
    )
    campaign_file.write_text(text.replace("shape_weight: 1.0", "shape_weight: {2: 1, others: 0.5}"))
    out = tmp_path / "proposed.yaml"
    write_proposal(campaign_file, screening(KS, ("k1", "k3")), out)
    assert parameters_of(out) == ("k1", "k3")
    assert "# left out: collinear" in out.read_text()
    proposed, whole = (load_campaign(path).case for path in (out, campaign_file))
    assert proposed.rules.by_hand == whole.rules.by_hand == {2: 2}


def parameters_of(path: Path) -> tuple[str, ...]:
    return load_campaign(path).parameters.names


def test_left_out_candidates_become_comments_with_their_reason(campaign_file: Path) -> None:
    out = write_proposal(
        campaign_file, screening(KS, ("k4", "k2")), campaign_file.with_name("proposed.yaml")
    )
    assert parameters_of(out) == ("k2", "k4")  # in the order of the user's file
    text, before = out.read_text(), campaign_file.read_text()
    kept = [line for line in before.splitlines() if "k1," not in line and "k3," not in line]
    assert all(line in text for line in kept if not line.startswith("name:"))
    assert "  # - {name: k1, quantity: spring_stiffness, elset: k1, bounds: [0.3, 3.0]}" in text
    assert "  # left out: collinear with k4 (cosine +0.987)" in text
    assert "# Proposed by modetune screen (a Latin hypercube, 20 points): 2 of 4" in text
    assert text.startswith("# yaml-language-server")  # editors look for it in the first line
    assert max(map(len, text.splitlines())) <= max(100, *map(len, before.splitlines()))


def test_the_proposal_keeps_everything_but_parameters_and_name(campaign_file: Path) -> None:
    out = write_proposal(
        campaign_file, screening(KS, ("k1", "k3")), campaign_file.with_name("proposed.yaml")
    )
    before, after = (yaml.safe_load(path.read_text()) for path in (campaign_file, out))
    assert after.pop("name") == "six-mass-screened"
    assert before.pop("name") == "six-mass"
    assert [item["name"] for item in after.pop("parameters")] == ["k1", "k3"]
    before.pop("parameters")
    assert after == before


def test_a_comment_is_all_that_stands_between_a_candidate_and_its_return(
    campaign_file: Path,
) -> None:
    out = write_proposal(
        campaign_file, screening(KS, ("k1",)), campaign_file.with_name("proposed.yaml")
    )
    out.write_text(out.read_text().replace("# - {name: k2", "- {name: k2"))
    assert parameters_of(out) == ("k1", "k2")


def test_blocks_of_several_lines_and_comments_between_them_are_kept(campaign_file: Path) -> None:
    text = campaign_file.read_text()
    start, end = text.index("parameters:"), text.index("residuals:")
    blocks = """parameters:
# the wall
- name: k1     # stiff
  quantity: spring_stiffness
  elset: k1
  bounds:
  - 0.3
  - 3.0

# between the masses
- name: k2
  quantity: spring_stiffness
  elset: [k2,
          k3]

- quantity: spring_stiffness
  elset: k4
  name: k4
# below all
"""
    campaign_file.write_text(text[:start] + blocks + text[end:])
    out = write_proposal(
        campaign_file, screening(("k1", "k2", "k4"), ("k4",)), campaign_file.with_name("p.yaml")
    )
    assert parameters_of(out) == ("k4",)
    written = out.read_text()
    for line in (
        "# the wall",
        "# between the masses",
        "# below all",
        "# - name: k1     # stiff",
        "#   - 3.0",
        "#           k3]",
    ):
        assert f"\n{line}\n" in written
    assert yaml.safe_load(written)["parameters"] == [
        {"quantity": "spring_stiffness", "elset": "k4", "name": "k4"}
    ]


def test_a_list_in_one_line_is_written_anew(campaign_file: Path) -> None:
    text = campaign_file.read_text()
    start, end = text.index("parameters:"), text.index("residuals:")
    item = "{name: k%d, quantity: spring_stiffness, elset: k%d}"
    flow = f"parameters: [{', '.join(item % (n, n) for n in (1, 2, 3))}]\n"
    campaign_file.write_text(text[:start] + flow + text[end:])
    out = write_proposal(
        campaign_file, screening(("k1", "k2", "k3"), ("k2",)), campaign_file.with_name("p.yaml")
    )
    assert parameters_of(out) == ("k2",)
    assert "Proposed by modetune screen" in out.read_text()


def test_an_anchor_of_a_left_out_candidate_is_resolved(campaign_file: Path) -> None:
    text = campaign_file.read_text()
    text = text.replace("k1, bounds: [0.3, 3.0]", "k1, bounds: &wide [0.3, 3.0]")
    text = text.replace("k2, bounds: [0.3, 3.0]", "k2, bounds: *wide")
    campaign_file.write_text(text)
    out = write_proposal(campaign_file, screening(KS, ("k2",)), campaign_file.with_name("p.yaml"))
    assert parameters_of(out) == ("k2",)
    assert load_campaign(out).parameters.lower.tolist() == [0.3]


def test_line_ends_stay_as_they_are(campaign_file: Path) -> None:
    campaign_file.write_bytes(campaign_file.read_bytes().replace(b"\n", b"\r\n"))
    out = write_proposal(campaign_file, screening(KS, ("k2",)), campaign_file.with_name("p.yaml"))
    written = out.read_bytes()
    assert written.count(b"\n") == written.count(b"\r\n")
    assert parameters_of(out) == ("k2",)


def test_paths_and_store_follow_to_another_folder(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    out = write_proposal(
        campaign_file, screening(KS, ("k2", "k3")), campaign_file.parent / "elsewhere" / "p.yaml"
    )
    assert parameters_of(out) == ("k2", "k3")
    before, after = load_campaign(campaign_file), load_campaign(out)
    assert after.store.folder.resolve() == before.store.folder.resolve()
    np.testing.assert_array_equal(after.test.modes.mode_shapes, before.test.modes.mode_shapes)
    assert "# - {name: k1," in out.read_text()


def test_the_campaign_itself_is_never_overwritten(campaign_file: Path) -> None:
    before = campaign_file.read_text()
    with pytest.raises(CampaignError, match="is the campaign itself"):
        write_proposal(campaign_file, screening(KS, ("k1",)), campaign_file)
    assert campaign_file.read_text() == before


def test_nothing_chosen_writes_nothing(campaign_file: Path) -> None:
    out = campaign_file.with_name("p.yaml")
    with pytest.raises(CampaignError, match="rejected all parameters"):
        write_proposal(campaign_file, screening(KS, ()), out)
    assert not out.exists()


def test_the_result_is_printed_although_the_file_cannot_be_written(campaign_file: Path) -> None:
    words = ("screen", "campaign.yaml", "--method", "local", "--out", "measured.csv/p.yaml")
    done = run_command(campaign_file.parent, *words)
    assert done.returncode == 5, done.stderr
    assert "proposed: k" in done.stdout
    assert "measured.csv is a file, and a folder is needed there" in done.stderr
    done = run_command(campaign_file.parent, *words, "--json")
    assert done.returncode == 5, done.stderr
    found = json.loads(done.stdout)
    assert found["status"] == "done"
    assert "a folder is needed there" in found["failure"]


def test_names_get_one_ending_and_stay_short() -> None:
    assert proposed_name("wing") == "wing-screened"
    assert proposed_name("wing-screened") == "wing-screened"
    assert len(proposed_name("w" * 64)) == 64


def test_a_reason_cannot_break_out_of_its_comment(campaign_file: Path) -> None:
    found = screening(KS, ("k1",))
    verdicts = [replace(item, reason="x\nname: evil\nstore: /") for item in found.choice.verdicts]
    found = replace(found, choice=replace(found.choice, verdicts=tuple(verdicts)))
    out = write_proposal(campaign_file, found, campaign_file.with_name("p.yaml"))
    assert yaml.safe_load(out.read_text())["name"] == "six-mass-screened"
